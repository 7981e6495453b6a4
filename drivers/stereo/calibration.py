"""The one file of a calibrated stereo pair: both lenses, and where the left camera sits from the right one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from semantic_mapper.config import AtLeastOne, Config, Positive, load_config
from semantic_mapper.drivers.calibration import Matrix, rigid_matrix
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.files import write_bytes
from semantic_mapper.types import CameraIntrinsics, Float64

_LENS_KEYS = ("fx", "fy", "cx", "cy", "width", "height")


class _Lens(Config, frozen=True):
    """One camera of the pair."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: AtLeastOne
    height: AtLeastOne
    distortion: tuple[float, ...] = ()

    def intrinsics(self) -> CameraIntrinsics:
        return CameraIntrinsics(self.fx, self.fy, self.cx, self.cy, self.width, self.height, self.distortion)


class _File(Config, frozen=True):
    """A stereo calibration as it stands on disk."""

    left: _Lens
    right: _Lens
    T_right_left: Matrix
    swapped: bool = False
    about: dict[str, Any] = msgspec.field(default_factory=dict)  # when, how, how well: for people


@dataclass(frozen=True, slots=True, eq=False)
class StereoCalibration:
    """A calibrated pair.

    Args:
        left, right: With distortion, both of one size.
        T_right_left: (4, 4) from the left camera to the right one, metres.
        swapped: The right camera's image is in the left half of what the device gives.
    """

    left: CameraIntrinsics
    right: CameraIntrinsics
    T_right_left: Float64
    swapped: bool = False


def load_stereo(path: Path) -> StereoCalibration:
    """Read the file of a pair.

    Raises:
        ConfigError: missing, the calibration of a single camera, of another form, or with impossible values.
    """
    try:
        file = load_config(path, _File)
        left, right = file.left.intrinsics(), file.right.intrinsics()
    except FrameError as error:
        raise ConfigError(f"{path}: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"{error}; `semantic-mapper calibrate --stereo` makes the file of a pair") from error
    if (left.width, left.height) != (right.width, right.height):
        raise ConfigError(
            f"{path}: the left images are {left.width}x{left.height}, the right ones {right.width}x{right.height}"
        )
    return StereoCalibration(left, right, rigid_matrix(file.T_right_left, f"{path}: T_right_left"), file.swapped)


def save_stereo(path: Path, pair: StereoCalibration, about: Mapping[str, str | float]) -> None:
    """Write the file of a pair, TOML, that reads back to the same numbers.

    Raises:
        OSError: it cannot be written.
    """
    lines = [
        f"swapped = {str(pair.swapped).lower()}",
        "T_right_left = [",
        *(f"    {row!r}," for row in pair.T_right_left.tolist()),
        "]",
    ]
    for side, lens in (("left", pair.left), ("right", pair.right)):
        lines += ["", f"[{side}]", *(f"{key} = {getattr(lens, key)!r}" for key in _LENS_KEYS)]
        lines.append(f"distortion = {list(lens.distortion)!r}")
    values = {key: json.dumps(value) if isinstance(value, str) else repr(value) for key, value in about.items()}
    lines += ["", "[about]", *(f"{key} = {value}" for key, value in values.items())]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, ("\n".join(lines) + "\n").encode())
