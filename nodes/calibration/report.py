"""What a calibration reports to people and programs, and the files it writes."""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.table import Table

from semantic_mapper import __version__
from semantic_mapper.config import Config
from semantic_mapper.drivers.calibrating.camera import COEFFICIENT_NAMES, CameraCalibration, draw_calibration
from semantic_mapper.drivers.calibrating.rig import Calibration
from semantic_mapper.drivers.calibrating.views import CELLS, CalibrationConfig, ViewGatherer, missing_regions
from semantic_mapper.drivers.calibration import StereoCalibration, save_calibration, save_stereo
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import write_bytes
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.nodes.calibration.sources import SIDES


class CalibrationSettings(Config, frozen=True):
    """The file that ``calibrate --config`` takes."""

    board: BoardPoses = BoardPoses()
    calibration: CalibrationConfig = CalibrationConfig()


def write_files(out: Path, found: Calibration, settings: CalibrationSettings) -> list[Path]:
    """A TOML file and a picture of each camera; returns their paths. ``ConfigError``: a file cannot be written."""
    written: list[Path] = []
    for name, camera in found.cameras.items():
        about = _about(settings) | {"views": len(camera.views), "rms_px": round(camera.rms_px, 4)}
        about |= {f"sigma_{key}": float(f"{sigma:.3g}") for key, sigma in camera.sigmas.items()}
        mount = None
        if found.rig is not None:
            place = found.rig.cameras[name]
            mount = place.T_rig_camera
            about["rig"] = f"that of camera {next(iter(found.cameras))}; {', '.join(found.cameras)}"
            about["rig_position_sigma_mm"] = float(f"{1000 * place.position_sigma_m:.3g}")
            about["rig_turn_sigma_deg"] = float(f"{place.turn_sigma_deg:.3g}")
        save_calibration(out / f"{name}.toml", camera.intrinsics, mount, about)
        written += [out / f"{name}.toml", _write_picture(out / f"{name}.png", name, camera)]
    return written


def write_stereo(out: Path, name: str, found: Calibration, settings: CalibrationSettings) -> list[Path]:
    """One TOML file of both cameras of a pair, and a picture of each; returns their paths.

    Cameras are named by the half of the image; their rig tells whose half is which. ``ConfigError``: a file cannot be
    written; it is as it was.
    """
    assert found.rig is not None
    left, right = (found.cameras[side] for side in SIDES)
    place = found.rig.cameras[SIDES[1]]
    T_right_left = invert_pose(place.T_rig_camera)
    swapped = bool(T_right_left[0, 3] > 0)
    if swapped:
        left, right, T_right_left = right, left, invert_pose(T_right_left)
    about = _about(settings) | {
        "views": min(len(left.views), len(right.views)),
        "moments": place.moments,
        "rms_px": round(found.rig.rms_px, 4),
        "baseline_mm": round(1000 * float(np.linalg.norm(T_right_left[:3, 3])), 3),
        "sigma_baseline_mm": float(f"{1000 * place.position_sigma_m:.3g}"),
    }
    file = out / f"{name}.toml"
    save_stereo(file, StereoCalibration(left.intrinsics, right.intrinsics, T_right_left, swapped), about)
    sides = zip(SIDES, (left, right), strict=True)
    return [file, *(_write_picture(out / f"{name}-{side}.png", f"{name} {side}", camera) for side, camera in sides)]


def _about(settings: CalibrationSettings) -> dict[str, str | float]:
    b = settings.board
    return {
        "made_by": f"semantic-mapper {__version__} calibrate",
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "board": f"{b.pattern} {b.columns}x{b.rows}, {1000 * b.square_m:g} mm",
    }


def _write_picture(path: Path, name: str, camera: CameraCalibration) -> Path:
    drawn = draw_calibration(name, camera)
    data = cv2.imencode(".png", np.ascontiguousarray(drawn[..., ::-1]))[1].tobytes()
    write_bytes(path, data, raises=ConfigError)
    return path


def tables(found: Calibration, gathered: Mapping[str, ViewGatherer], worst: int) -> Iterator[Any]:
    """Tables for people; so many of the worst views are named."""
    for name, camera in found.cameras.items():
        yield _camera_table(name, camera, gathered[name], worst)
    if found.rig is not None:
        caption = f"{found.rig.rms_px:.3f} px RMS of all corners at once"
        titles = ("camera", "moments", "x, y, z on the rig (mm)", "+- mm", "turned (deg)", "+- deg")
        table = Table(*titles, title="rig", title_justify="left", caption=caption)
        for name, place in found.rig.cameras.items():
            turned = np.degrees(np.linalg.norm(rotation_vector(place.T_rig_camera)))
            position = ", ".join(f"{1000 * v:.1f}" for v in place.T_rig_camera[:3, 3])
            sigmas = f"{1000 * place.position_sigma_m:.2f}", f"{place.turn_sigma_deg:.3f}"
            table.add_row(name, str(place.moments), position, sigmas[0], f"{turned:.2f}", sigmas[1])
        yield table


def _values(camera: CameraCalibration) -> dict[str, float]:
    i = camera.intrinsics
    values = {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy}
    return values | dict(zip(COEFFICIENT_NAMES, i.distortion, strict=False))


def _camera_table(name: str, camera: CameraCalibration, views: ViewGatherer, worst: int) -> Table:
    i = camera.intrinsics
    table = Table(title=f"{name}, {i.width} x {i.height}", title_justify="left", show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    left_out = f"; {len(camera.left_out)} did not fit: {', '.join(camera.left_out)}" if camera.left_out else ""
    table.add_row(
        "images", f"{views.images} looked at, {views.seen} with the board, {len(camera.views)} used{left_out}"
    )
    table.add_row("error", f"{camera.rms_px:.3f} px RMS")
    order = sorted(zip(camera.errors_px, camera.views, strict=True), key=lambda pair: -pair[0])
    table.add_row("worst images", ", ".join(f"{view.name} {error:.2f} px" for error, view in order[:worst]))
    if not camera.estimated:
        table.add_row("intrinsics", "as the source gives them")
    for key, value in _values(camera).items():
        sigma = f" +- {camera.sigmas[key]:.2g}" if key in camera.sigmas else ""
        table.add_row(key, f"{value:.2f}{sigma}" if key in ("fx", "fy", "cx", "cy") else f"{value:.5f}{sigma}")
    missing = ", ".join(missing_regions(camera.counts))
    seen = f"{np.count_nonzero(camera.counts)} of {CELLS * CELLS} cells" + (f"; hardly: {missing}" if missing else "")
    table.add_row("image area seen", seen)
    up, side = np.abs(camera.tilts).max(axis=0)
    table.add_row("board leaned", f"up to {up:.0f} degrees up or down, {side:.0f} to a side")
    return table


def as_json(found: Calibration, gathered: Mapping[str, ViewGatherer], files: list[Path]) -> dict[str, Any]:
    """The same for programs."""
    cameras, rig = {}, None
    for name, camera in found.cameras.items():
        views = gathered[name]
        cameras[name] = {
            "size": [camera.intrinsics.width, camera.intrinsics.height],
            "estimated": camera.estimated,
            **_values(camera),
            "sigmas": camera.sigmas,
            "rms_px": camera.rms_px,
            "images": {"looked_at": views.images, "with_board": views.seen, "left_out": list(camera.left_out)},
            "errors_px": {view.name: error for view, error in zip(camera.views, camera.errors_px, strict=True)},
            "cells_seen": int(np.count_nonzero(camera.counts)),
            "cells": CELLS * CELLS,
            "leaned_deg": np.abs(camera.tilts).max(axis=0).tolist(),
        }
    if found.rig is not None:
        places = {n: asdict(p) | {"T_rig_camera": p.T_rig_camera.tolist()} for n, p in found.rig.cameras.items()}
        rig = {"rms_px": found.rig.rms_px, "cameras": places}
    return {"cameras": cameras, "rig": rig, "files": [str(path) for path in files]}
