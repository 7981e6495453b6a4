"""Posed camera frames in, live semantic 3D map out.

The names below are the public interface; each loads its module when it is first used.
"""

import importlib as _importlib
import os as _os
import sys as _sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semantic_mapper.client import MapClient
    from semantic_mapper.errors import SemanticMapperError
    from semantic_mapper.fields.checkpoint import load_checkpoint as load_weights
    from semantic_mapper.labels import LabelSet
    from semantic_mapper.mapper import Mapper
    from semantic_mapper.mapping.changes import BlockChanges, ClearedBlocks
    from semantic_mapper.mapping.floor_plan import OccupancyGrid
    from semantic_mapper.mapping.map_types import CameraPose, MapPoints
    from semantic_mapper.mapping.voxel_map import VoxelMap
    from semantic_mapper.queries.find import FoundObject
    from semantic_mapper.queries.graph import Door, Floor, Room, SceneGraph
    from semantic_mapper.queries.instances import Instance, OrientedBox
    from semantic_mapper.queries.nearest import NearestSurface, PointAnswers
    from semantic_mapper.queries.objects import MapObject, ObjectPlace
    from semantic_mapper.queries.occupancy import DistanceField, State
    from semantic_mapper.queries.questions import Correction, MapInfo, RememberedObjects, Weights, WeightsEntry
    from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
    from semantic_mapper.queries.surface import RayHits
    from semantic_mapper.queries.text_encoder import TextEncoder
    from semantic_mapper.replay.log.sequence import open_log
    from semantic_mapper.training.finetune import finetune
    from semantic_mapper.types import PosedFrame

__all__ = [
    "BlockChanges",
    "CameraPose",
    "ClearedBlocks",
    "Correction",
    "DistanceField",
    "Door",
    "Floor",
    "FoundObject",
    "Instance",
    "LabelSet",
    "MapClient",
    "MapInfo",
    "MapMirror",
    "MapObject",
    "MapPoints",
    "MapSnapshot",
    "Mapper",
    "NearestSurface",
    "ObjectPlace",
    "OccupancyGrid",
    "OrientedBox",
    "PointAnswers",
    "PosedFrame",
    "RayHits",
    "RememberedObjects",
    "Room",
    "SceneGraph",
    "SemanticMapperError",
    "State",
    "TextEncoder",
    "VoxelMap",
    "Weights",
    "WeightsEntry",
    "finetune",
    "load_weights",
    "open_log",
]
__version__ = "0.1.0"

# OpenMP reads this once, when torch is loaded. Its threads otherwise spin for milliseconds after an operation and take
# the cores from the kernels, which run on threads of their own; `kernels.binding` fixes it where torch came first.
SPINNING_THREADS = "torch" in _sys.modules and "OMP_WAIT_POLICY" not in _os.environ
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# OpenBLAS reads this once, when numpy is loaded. Its threads spin for 20 ms, and split sums by their number.
BLAS_THREADS = "numpy" in _sys.modules and "OPENBLAS_NUM_THREADS" not in _os.environ
_os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# OpenVINO would report its import over the network, by a process that runs the user's script again on Python 3.14.
_sys.modules.setdefault("openvino_telemetry", None)  # pyright: ignore[reportArgumentType]

_HOMES = {  # modules below this package, by name; where it is called otherwise there, as MODULE:NAME
    "MapClient": "client",
    "SemanticMapperError": "errors",
    "load_weights": "fields.checkpoint:load_checkpoint",
    "LabelSet": "labels",
    "Mapper": "mapper",
    **dict.fromkeys(("BlockChanges", "ClearedBlocks"), "mapping.changes"),
    "OccupancyGrid": "mapping.floor_plan",
    **dict.fromkeys(("CameraPose", "MapPoints"), "mapping.map_types"),
    "VoxelMap": "mapping.voxel_map",
    "FoundObject": "queries.find",
    **dict.fromkeys(("Door", "Floor", "Room", "SceneGraph"), "queries.graph"),
    **dict.fromkeys(("Instance", "OrientedBox"), "queries.instances"),
    **dict.fromkeys(("NearestSurface", "PointAnswers"), "queries.nearest"),
    **dict.fromkeys(("MapObject", "ObjectPlace"), "queries.objects"),
    **dict.fromkeys(("DistanceField", "State"), "queries.occupancy"),
    **dict.fromkeys(("Correction", "MapInfo", "RememberedObjects", "Weights", "WeightsEntry"), "queries.questions"),
    **dict.fromkeys(("MapMirror", "MapSnapshot"), "queries.snapshot"),
    "RayHits": "queries.surface",
    "TextEncoder": "queries.text_encoder",
    "open_log": "replay.log.sequence",
    "finetune": "training.finetune",
    "PosedFrame": "types",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOMES[name].partition(":")
    value = getattr(_importlib.import_module(f"{__name__}.{module}"), attribute or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
