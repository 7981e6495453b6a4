"""What a calibration reports to people and programs, and the files it writes."""

import datetime
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from semantic_mapper import __version__
from semantic_mapper.config import Config
from semantic_mapper.drivers.calibrating.camera import COEFFICIENT_NAMES
from semantic_mapper.drivers.calibrating.rig import Calibration
from semantic_mapper.drivers.calibrating.views import CELLS, CalibrationConfig, ViewGatherer, missing_regions
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.geometry import rotation_vector
from semantic_mapper.nodes.console import table

_WORST = 3  # views named in the tables


class CalibrationSettings(Config, frozen=True):
    """The file that ``calibrate --config`` takes."""

    board: BoardPoses = BoardPoses()
    calibration: CalibrationConfig = CalibrationConfig()


def write_files(out: Path, found: Calibration, settings: CalibrationSettings) -> list[Path]:
    """A TOML file of each camera; returns their paths. ``ConfigError``: a file cannot be written."""
    written: list[Path] = []
    for name, camera in found.cameras.items():
        about = _about(settings) | {"views": len(camera.views), "rms_px": round(camera.rms_px, 4)}
        about |= {f"sigma_{key}": _rounded(sigma) for key, sigma in camera.sigmas.items()}
        place = found.rig.get(name)
        if place is not None:
            about["rig"] = f"that of camera {next(iter(found.cameras))}; {', '.join(found.cameras)}"
            about["rig_position_sigma_mm"] = _rounded(1000 * place.position_sigma_m)
            about["rig_turn_sigma_deg"] = _rounded(place.turn_sigma_deg)
        file = out / f"{name}.toml"
        save_calibration(file, camera.intrinsics, None if place is None else place.T_rig_camera, about)
        written.append(file)
    return written


def _rounded(value: float) -> float:
    return float(f"{value:.3g}")


def _about(settings: CalibrationSettings) -> dict[str, str | float]:
    b = settings.board
    return {
        "made_by": f"semantic-mapper {__version__} calibrate",
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "board": f"{b.pattern} {b.columns}x{b.rows}, {1000 * b.square_m:g} mm",
    }


def as_json(found: Calibration, gathered: Mapping[str, ViewGatherer], files: list[Path]) -> dict[str, Any]:
    """What came out, for programs."""
    cameras, rig = {}, None
    for name, camera in found.cameras.items():
        views, k = gathered[name], camera.intrinsics
        cameras[name] = {
            "size": [k.width, k.height],
            "estimated": bool(camera.sigmas),
            **{key: getattr(k, key) for key in ("fx", "fy", "cx", "cy")},
            **dict(zip(COEFFICIENT_NAMES, k.distortion, strict=False)),
            "sigmas": camera.sigmas,
            "rms_px": camera.rms_px,
            "images": {"looked_at": views.images, "with_board": views.seen, "left_out": list(camera.left_out)},
            "errors_px": {view.name: error for view, error in zip(camera.views, camera.errors_px, strict=True)},
            "cells_seen": int(np.count_nonzero(camera.counts)),
            "cells": CELLS * CELLS,
            "hardly_seen": missing_regions(camera.counts),
            "leaned_deg": np.abs(camera.tilts).max(axis=0).tolist(),
        }
    if found.rig:
        places = {n: asdict(p) | {"T_rig_camera": p.T_rig_camera.tolist()} for n, p in found.rig.items()}
        rig = {"rms_px": found.rig_rms_px, "cameras": places}
    return {"cameras": cameras, "rig": rig, "files": [str(path) for path in files]}


def tables(plain: dict[str, Any]) -> Iterator[Table]:
    """What ``as_json`` tells, for people."""
    for name, camera in plain["cameras"].items():
        width, height = camera["size"]
        images, errors, left_out = camera["images"], camera["errors_px"], camera["images"]["left_out"]
        used = f"{len(errors)} used" + (f"; {len(left_out)} did not fit: {', '.join(left_out)}" if left_out else "")
        worst = sorted(errors.items(), key=lambda item: -item[1])[:_WORST]
        rows = [
            ("images", f"{images['looked_at']} looked at, {images['with_board']} with the board, {used}"),
            ("error", f"{camera['rms_px']:.3f} px RMS"),
            ("worst images", ", ".join(f"{view} {error:.2f} px" for view, error in worst)),
        ]
        for key in ("fx", "fy", "cx", "cy", *COEFFICIENT_NAMES):
            if key in camera:
                sigma = f" +- {camera['sigmas'][key]:.2g}" if camera["estimated"] else " as the source gives it"
                rows.append((key, f"{camera[key]:.{5 if key in COEFFICIENT_NAMES else 2}f}{sigma}"))
        missing = f"; hardly: {', '.join(camera['hardly_seen'])}" if camera["hardly_seen"] else ""
        rows.append(("image area seen", f"{camera['cells_seen']} of {camera['cells']} cells{missing}"))
        up, side = camera["leaned_deg"]
        rows.append(("board leaned", f"up to {up:.0f} degrees up or down, {side:.0f} to a side"))
        yield table(rows, title=f"{name}, {width} x {height}")
    if plain["rig"] is not None:
        caption = f"{plain['rig']['rms_px']:.3f} px RMS of all corners at once"
        titles = ("camera", "moments", "x, y, z on the rig (mm)", "+- mm", "turned (deg)", "+- deg")
        rows: list[tuple[object, ...]] = []
        for name, place in plain["rig"]["cameras"].items():
            T = np.array(place["T_rig_camera"])
            position = ", ".join(f"{1000 * v:.1f}" for v in T[:3, 3])
            turned = np.degrees(np.linalg.norm(rotation_vector(T)))
            sigmas = f"{1000 * place['position_sigma_m']:.2f}", f"{place['turn_sigma_deg']:.3f}"
            rows.append((name, place["moments"], position, sigmas[0], f"{turned:.2f}", sigmas[1]))
        yield table(rows, titles, title="rig", caption=caption)
