"""Where a camera sits on its rig: from its settings, else from its calibration file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semantic_mapper.drivers.calibration import Matrix, load_mount, rigid_matrix
from semantic_mapper.drivers.poses.config import PoseConfig, poses_of_rig
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import Float64

OTHER_FILES = ("oak", "stereo")  # kinds whose `calibration` is a file of another form


def mount_for(
    poses: PoseConfig, rows: Matrix | None, kind: str, config: Mapping[str, Any], camera: str
) -> Float64 | None:
    """T_rig_camera (4, 4) where poses are those of a rig; None where they are the camera's own.

    Args:
        poses: Settings of their source.
        rows: T_rig_camera of the camera's settings.
        kind: Of the camera; ``config``: its driver's settings, which may name a calibration file.
        camera: For messages.

    ``ConfigError``: it is needed and not known, requested and without effect, or no rigid transform.
    """
    if not poses_of_rig(poses):
        if rows is None:
            return None
        raise ConfigError(
            f'{camera}: has a T_rig_camera, but its poses (kind "{poses.kind}") are the camera\'s own; of a '
            'rig they are with T_base_rig (kind "topic") or T_world_rig (kind "fixed")'
        )
    if rows is not None:
        return rigid_matrix(rows, f"{camera}: T_rig_camera")
    file = config.get("calibration", "")
    mount = load_mount(Path(file)) if file and kind not in OTHER_FILES else None
    if mount is None:
        raise ConfigError(
            f"{camera}: its poses are those of a rig, and nothing says where it sits there; give "
            "T_rig_camera, or a calibration file that has one (`semantic-mapper calibrate` with all cameras)"
        )
    return mount
