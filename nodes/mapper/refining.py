"""The process that refines one saved map beside a mapper (``live_refinement.py``): its arguments, files and work.

Imports nothing heavy before its priority is set.
"""

from __future__ import annotations

import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.process import prepare_process, run_when_idle

if TYPE_CHECKING:
    from semantic_mapper.mapping.instance_layer import InstanceLayer
    from semantic_mapper.mapping.storage.changes import BlockChanges

REFINED_NAME = "refined.npz"
_ARRAYS = ("keys", "tsdf", "label", "confidence", "rgb", "computed")


@dataclass(frozen=True, slots=True)
class Job:
    """What is to be refined.

    Args:
        source: A copy of the saved map; results are written beside it.
        weights: As of ``find_nesf``.
        idle: Compute only while nobody else wants the processor.
    """

    source: Path
    weights: Path | None
    idle: bool

    @property
    def refined(self) -> Path:
        """The refined map."""
        return self.source.with_name(REFINED_NAME)

    @property
    def changes(self) -> Path:
        """Its blocks, as queries have them."""
        return self.source.with_name("changes.npz")

    def arguments(self) -> list[str]:
        """For ``of``."""
        return [str(self.source), str(self.weights or ""), "idle" if self.idle else "busy"]

    @classmethod
    def of(cls, arguments: list[str]) -> Job:
        """What ``arguments`` wrote."""
        source, weights, priority = arguments
        return cls(Path(source), Path(weights) if weights else None, priority == "idle")


def read_changes(path: Path, version: int, epoch: int) -> tuple[BlockChanges, InstanceLayer | None]:
    """All blocks of a refined map, as of the version and epoch that was refined, and its instances if it has them.

    Raises:
        OSError: it cannot be read.
    """
    from semantic_mapper.mapping.instance_layer import InstanceLayer
    from semantic_mapper.mapping.storage.changes import BlockChanges

    with np.load(path) as file:
        arrays = {name: file[name] for name in _ARRAYS if name in file}
        scale_known = bool(file["scale_known"])
        layer = InstanceLayer(file["packed"], file["number"]) if "packed" in file else None
    return BlockChanges(0, version, version, epoch, scale_known=scale_known, **arrays), layer


def refine_job(job: Job) -> None:
    """Refine the map of a job, and write both results.

    Raises:
        MapError, WeightsError: it cannot be refined, read or written.
    """
    from semantic_mapper.fields.nesf import find_nesf
    from semantic_mapper.mapping.refine import refine
    from semantic_mapper.mapping.voxel_map import VoxelMap

    voxel_map = VoxelMap.load(job.source)
    refine(voxel_map, find_nesf(job.weights, voxel_map.label_set))
    voxel_map.save(job.refined)
    found = voxel_map.changes(0)
    arrays: dict[str, Any] = {name: array for name in _ARRAYS if (array := getattr(found, name)) is not None}
    if voxel_map.instances is not None:
        arrays |= {"packed": voxel_map.instances.packed, "number": voxel_map.instances.number}
    np.savez(job.changes, scale_known=np.bool_(found.scale_known), **arrays)


def main() -> None:
    """Do the job of the arguments; ends at once when the mapper does, whose end closes our standard input."""
    threading.Thread(target=_end_with_mapper, daemon=True).start()
    job = Job.of(sys.argv[1:])
    if job.idle:
        os.nice(19)
        run_when_idle()
    prepare_process()
    try:
        refine_job(job)
    except SemanticMapperError as error:
        sys.exit(str(error))


def _end_with_mapper() -> None:
    while os.read(0, 1):  # not sys.stdin, whose lock would be held when the interpreter ends
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
