"""Where a camera sits on its rig: from its settings, else from its calibration file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semantic_mapper.drivers.calibration import Matrix, load_mount, rigid_matrix
from semantic_mapper.drivers.poses.config import PoseConfig, poses_of_rig
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import Float64

OTHER_FILES = ("oak", "stereo")  # kinds whose `calibration` is a file of another form


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """A camera's place on a rig."""

    T_rig_camera: Float64 | None  # (4, 4); None where nobody has said
    requested: bool  # whether the settings name it; a calibration file just has it
    camera: str  # for messages

    def for_poses(self, poses: PoseConfig) -> Float64 | None:
        """T_rig_camera where poses are those of the rig; None where they are the camera's own.

        Raises:
            ConfigError: it is needed and not known, or requested and without effect.
        """
        if poses_of_rig(poses):
            if self.T_rig_camera is None:
                raise ConfigError(
                    f"{self.camera}: its poses are those of a rig, and nothing says where it sits there; give "
                    "T_rig_camera, or a calibration file that has one (`semantic-mapper calibrate` with all cameras)"
                )
            return self.T_rig_camera
        if self.requested:
            raise ConfigError(
                f'{self.camera}: has a T_rig_camera, but its poses (kind "{poses.kind}") are the camera\'s own; of a '
                'rig they are with T_base_rig (kind "topic") or T_world_rig (kind "fixed")'
            )
        return None


def mount_of(rows: Matrix | None, kind: str, config: Mapping[str, Any], camera: str) -> Mount:
    """What is known of a camera's place.

    Args:
        rows: Of the settings.
        kind: Of the camera; ``config``: its driver's settings, which may name a calibration file.
        camera: For messages.

    Raises:
        ConfigError: no rigid transform, or the file cannot be read.
    """
    if rows is not None:
        return Mount(rigid_matrix(rows, f"{camera}: T_rig_camera"), True, camera)
    file = config.get("calibration", "")
    known = load_mount(Path(file)) if file and kind not in OTHER_FILES else None
    return Mount(known, False, camera)
