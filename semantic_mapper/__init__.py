"""Posed camera frames in, live semantic 3D map out.

The names below are the public interface; each loads its module when it is first used.
"""

import importlib as _importlib
import os as _os
import sys as _sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semantic_mapper.client import MapClient as MapClient
    from semantic_mapper.fields.checkpoint import load_checkpoint as load_weights
    from semantic_mapper.mapper import Mapper as Mapper
    from semantic_mapper.mapping.voxel_map import VoxelMap as VoxelMap
    from semantic_mapper.replay.log.sequence import open_log as open_log
    from semantic_mapper.training.finetune import finetune as finetune
    from semantic_mapper.types import PosedFrame as PosedFrame

__all__ = ["MapClient", "Mapper", "PosedFrame", "VoxelMap", "finetune", "load_weights", "open_log"]
__version__ = "0.1.0"

# OpenMP reads this once, when torch is loaded. Its threads otherwise spin for milliseconds after an operation and take
# the cores from the kernels, which run on threads of their own; `kernels.binding` fixes it where torch came first.
SPINNING_THREADS = "torch" in _sys.modules and "OMP_WAIT_POLICY" not in _os.environ
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_HOMES = {
    "MapClient": ("semantic_mapper.client", "MapClient"),
    "Mapper": ("semantic_mapper.mapper", "Mapper"),
    "PosedFrame": ("semantic_mapper.types", "PosedFrame"),
    "VoxelMap": ("semantic_mapper.mapping.voxel_map", "VoxelMap"),
    "finetune": ("semantic_mapper.training.finetune", "finetune"),
    "load_weights": ("semantic_mapper.fields.checkpoint", "load_checkpoint"),
    "open_log": ("semantic_mapper.replay.log.sequence", "open_log"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _HOMES[name]
    value = getattr(_importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
