"""What the frames of a camera node are called: readers tell cameras apart by that alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from semantic_mapper.errors import LogError
from semantic_mapper.nodes.options import CameraOptions
from semantic_mapper.replay.log.sequence import open_log


def check_camera_ids(reader: str, cameras: Mapping[str, CameraOptions]) -> None:
    """Raise ``ValueError`` for frames of one name from two cameras, by node name, that node ``reader`` takes."""
    if len(cameras) < 2:
        return
    taken: dict[str, str] = {}
    for node, options in cameras.items():
        for name in _camera_ids(options):
            other = taken.setdefault(name, node)
            if other == node:
                continue
            fix = "give each its own `id`"
            if options.log is not None or cameras[other].log is not None:
                fix = (
                    "frames of a log keep the names that they were recorded under: record one again with another `id`, "
                    "or give each log a mapper of its own; parts of one recording are one node with their folder"
                )
            raise ValueError(f"two cameras of node '{reader}', '{other}' and '{node}', have the id '{name}'; {fix}")


def _camera_ids(options: CameraOptions) -> tuple[str, ...]:
    """Of a camera, or of those in a log; none where the log cannot be read, which its node will say."""
    if options.camera is not None:
        return (options.camera.id,)
    try:
        with open_log(Path(str(options.log))) as log:
            return tuple(log.info.cameras)
    except (LogError, OSError):
        return ()
