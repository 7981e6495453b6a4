"""From gathered views to calibrated cameras and, where there are several, their rig."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from semantic_mapper.drivers.calibrating.config import CalibrationConfig
from semantic_mapper.drivers.calibrating.extrinsics import RigCalibration, calibrate_rig
from semantic_mapper.drivers.calibrating.intrinsics import CameraCalibration, calibrate_camera, compare_camera
from semantic_mapper.drivers.calibrating.views import ViewGatherer, simultaneous
from semantic_mapper.errors import CameraError


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """All that came out.

    Args:
        cameras: By name; rig: None where it was not requested.
    """

    cameras: dict[str, CameraCalibration]
    rig: RigCalibration | None


def solve(
    gathered: Mapping[str, ViewGatherer], known: Collection[str], config: CalibrationConfig, *, rig: bool
) -> Calibration:
    """Calibrate.

    Args:
        gathered: By camera; the first one is where the rig is.
        known: Cameras whose intrinsics are right as their source tells them.
        config: What a result has to be like.
        rig: Also find where the cameras sit relative to each other.

    Raises:
        CameraError: one of them cannot be calibrated; says why and what to do.
    """
    cameras: dict[str, CameraCalibration] = {}
    for name, views in gathered.items():
        if views.size is None or views.intrinsics is None:
            raise CameraError(f"camera '{name}': gave no image")
        if not views.seen:
            raise CameraError(
                f"camera '{name}': the board was found in none of {views.images} images; are its columns, rows, "
                "dictionary and pattern those of the settings (`calibrate --board FILE.png` draws the board that is "
                "looked for)?"
            )
        if name in known:
            cameras[name] = compare_camera(name, views.kept or views.steady, views.intrinsics, config)
        else:
            cameras[name] = calibrate_camera(name, views.kept, views.size, config)
    if not rig:
        return Calibration(cameras, None)
    instants = simultaneous({name: views.steady for name, views in gathered.items()}, config)
    found = calibrate_rig({name: camera.intrinsics for name, camera in cameras.items()}, instants, config)
    return Calibration(cameras, found)
