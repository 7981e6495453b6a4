"""Runs of the command over the golden log, and what is measured on what they leave."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from semantic_mapper.mapping.voxel_map import VoxelMap
from tests.contract import entry_points as api
from tests.contract.golden import LOG, ROOM_SETTINGS, WEIGHTS

QUANTILES = (5, 25, 50, 75, 95)  # percent, of confidences
STEP_M, STEP_P = 1e-4, 1 / 65535  # of golden coordinates and confidences
KITCHEN_FRAMES = 40


class Points(NamedTuple):
    """The vertices of a PLY file."""

    xyz: np.ndarray  # (N, 3) float32
    rgb: np.ndarray  # (N, 3) uint8
    label: np.ndarray  # (N,) uint8
    confidence: np.ndarray  # (N,) float32


def replay_room(folder: Path, *more: str | Path) -> Path:
    """``map`` of the golden log with the golden weights at 5 cm, in this process."""
    config = folder / "room.toml"
    config.write_text(ROOM_SETTINGS, encoding="utf-8")
    out = folder / "run"
    ran = api.run_here("map", LOG, "--weights", WEIGHTS, "--config", config, "--out", out, *more)
    assert ran.code == 0, ran.stderr
    return out


def replay_kitchen(sequence: Path, folder: Path) -> Path:
    """``import`` and ``map`` of a real recording with the weights of the package at 5 cm, in this process."""
    log, config = folder / "kitchen.mcap", folder / "room.toml"
    config.write_text(ROOM_SETTINGS, encoding="utf-8")
    ran = api.run_here("import", sequence, log, "--max-frames", str(KITCHEN_FRAMES))
    assert ran.code == 0, ran.stderr
    ran = api.run_here("map", log, "--config", config, "--out", folder / "run")
    assert ran.code == 0, ran.stderr
    return folder / "run"


def read_ply(path: Path) -> tuple[Points, list[str], int]:
    """Points, lines of the header and number of faces of a binary PLY file, read as its header says."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    sizes = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    kinds = {"float": "<f4", "uchar": "u1"}
    fields = [line.split()[1:] for line in lines if line.startswith("property") and " list " not in line]
    rows = np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in fields]), sizes["vertex"])
    faces = sizes.get("face", 0)
    assert len(body) == rows.nbytes + 13 * faces
    xyz, rgb = (np.stack([rows[name] for name in names], 1) for names in (("x", "y", "z"), ("red", "green", "blue")))
    return Points(xyz, rgb, rows["label"], rows["confidence"]), lines, faces


def summary_of(run: Path) -> dict[str, Any]:
    """The summary that a run has left."""
    return json.loads((run / "summary.json").read_text(encoding="utf-8"))


def numbers_of(run: Path) -> dict[str, Any]:
    """What is held of a run as numbers."""
    summary = summary_of(run)
    points, _, _ = read_ply(run / "map.ply")
    state = VoxelMap.load(run / "map.npz").block_state()
    ids, counts = np.unique(points.label, return_counts=True)
    depth = summary["pose_check"]["worst_depth_disagreement"]
    return {
        "frames": summary["frames"],
        "refused": [[r["seq"], r["stamp_ns"]] for r in summary["refusals"]],
        "blocks": summary["map"]["blocks"],
        "surface_points": summary["map"]["surface_points"],
        "classes": {summary["labels"].get(str(i), "unknown"): int(n) for i, n in zip(ids, counts, strict=True)},
        "confidence": np.percentile(points.confidence, QUANTILES).tolist(),
        "miou": summary["metrics"]["miou"],
        "map_miou": summary["metrics"]["map_miou"],
        "coverage": summary["metrics"]["coverage"],
        "total_accuracy": summary["metrics"]["total_accuracy"],
        "votes": float(np.sum(state["votes"], dtype=np.float64)),
        "weight": float(np.sum(state["weight"], dtype=np.float64)),
        "observed_voxels": int(np.count_nonzero(state["weight"])),
        "worst_depth_disagreement": depth,
    }


def save_points(path: Path, points: Points) -> None:
    """Golden points, rounded to steps far below what is distinguished."""
    least = points.xyz.min(0)
    np.savez_compressed(
        path,
        least=least,
        xyz=np.rint((points.xyz - least) / STEP_M).astype(np.uint16),
        rgb=points.rgb,
        label=points.label,
        confidence=np.rint(points.confidence / STEP_P).astype(np.uint16),
    )


def load_points(path: Path) -> Points:
    """Inverse of ``save_points``."""
    with np.load(path) as kept:
        xyz = kept["least"].astype(np.float64) + kept["xyz"] * STEP_M
        return Points(xyz, kept["rgb"], kept["label"], kept["confidence"] * STEP_P)


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Numbers of nested tables by dotted name."""
    found: dict[str, float] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, list):
            found |= flat({str(i): item for i, item in enumerate(value)}, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
