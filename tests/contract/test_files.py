"""Files that earlier versions wrote are read: maps, results, weights, calibrations, keys, corrections, keyframes."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.drivers.calibration import load_calibration, load_mount
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.finetuner.keyframe_store import LearningStore
from semantic_mapper.nodes.launcher.launch_file import load_launch
from semantic_mapper.replay.corrected_poses import read_corrections
from semantic_mapper.testing import LogReplays
from semantic_mapper.training.online import KeyframePool
from semantic_mapper.transport.keys import load_keys
from tests.contract import entry_points as api
from tests.contract.golden import (
    FOLDER,
    LOG,
    MAP,
    MAP_COARSE,
    STORED,
    STORED_FRAMES,
    STORED_SETTINGS,
    WEIGHTS,
    differences,
    leaves,
    plain,
    read,
)

CALIBRATIONS = FOLDER / "calibrations"
KEYS, LEARNING = FOLDER / "keys", FOLDER / "learning"
CORRECTIONS, LAUNCH_FILE = FOLDER / "corrections.tum", FOLDER / "all-kinds.toml"
POINT_M = 1e-5  # of points read out of a saved map: it is the same map, so float32 rounding at some metres


def observe(folder: Path) -> dict[str, Any]:
    """What the files of today hold."""
    return {name: look(folder) for name, look in _LOOKS.items()}


def look_at_map(path: Path) -> dict[str, Any]:
    """Frames, settings, classes, all voxels and the surface of a saved map."""
    voxel_map = VoxelMap.load(path)
    points = voxel_map.points()
    return {
        "frames": voxel_map.frames,
        "last_stamp_ns": voxel_map.last_stamp_ns,
        "blocks": voxel_map.block_count,
        "config": leaves(voxel_map.config),
        "label_set": plain(voxel_map.label_set),
        "state": plain(voxel_map.block_state()),
        "surface": {
            "points": len(points.xyz),
            "least": points.xyz.min(0).tolist(),
            "most": points.xyz.max(0).tolist(),
            "mean": points.xyz.mean(0, dtype=np.float64).tolist(),
            "labels": np.bincount(points.label).tolist(),
            "confidence": float(points.confidence.mean(dtype=np.float64)),
        },
    }


def look_at_weights(_: Path) -> dict[str, Any]:
    """Classes, training and network of the golden weights."""
    checkpoint = load_checkpoint(WEIGHTS)
    tensors = {name: plain(tensor.numpy()) for name, tensor in checkpoint.model.state_dict().items()}
    return {
        "kind": checkpoint.model.kind,
        "width": checkpoint.width,
        "stamps": sorted(checkpoint.train_stamps_ns),
        "label_set": plain(checkpoint.label_set),
        "anchors": [plain(frame) for frame in checkpoint.anchors],
        "config": leaves(checkpoint.model.config),
        "tensors": tensors,
    }


def look_at_calibrations(_: Path) -> dict[str, Any]:
    """Intrinsics and mounts."""
    return {
        path.name: {"intrinsics": plain(load_calibration(path)), "mount": plain(load_mount(path))}
        for path in sorted(CALIBRATIONS.iterdir())
    }


def look_at_keys(folder: Path) -> dict[str, Any]:
    """Public keys; git does not keep that the secret one is for its owner alone."""
    copy = folder / "keys"
    shutil.copytree(KEYS, copy)
    (copy / "own.key_secret").chmod(0o600)
    keys = load_keys(copy)
    peers = {name: key.decode() for name, key in keys.peers().items()}
    return {"public": keys.public.decode(), "secret": plain(keys.secret), "peers": peers}


def look_at_corrections(_: Path) -> dict[str, Any]:
    """Stamps and poses."""
    found = read_corrections(CORRECTIONS)
    return {"stamps_ns": found.stamps_ns.tolist(), "poses": found.poses.round(12).ravel().tolist()}


def look_at_launch(_: Path) -> dict[str, Any]:
    """Nodes with their options."""
    launch = load_launch(LAUNCH_FILE)
    return {
        "nodes": {node.name: {"kind": node.kind, "entry": leaves(node)} for node in launch.nodes},
        "options": {name: leaves(options) for name, options in launch.options.items()},
        "inputs": {name: list(options.inputs()) for name, options in launch.options.items()},
        "all": leaves(launch),
    }


def look_at_learning(folder: Path) -> dict[str, Any]:
    """Keyframes and progress that a finetuner keeps."""
    copy = folder / "learning"
    shutil.copytree(LEARNING, copy)
    pool = KeyframePool(ROOMS, held_out_every=2, capacity=8)
    progress = LearningStore(copy, ROOMS).restore(pool)
    return {"kept": {str(k.frame.stamp_ns): leaves(k) for k in pool.kept}, "progress": leaves(progress)}


_LOOKS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "map": lambda _: look_at_map(MAP),
    "map_coarse": lambda _: look_at_map(MAP_COARSE),
    "weights": look_at_weights,
    "calibrations": look_at_calibrations,
    "keys": look_at_keys,
    "corrections": look_at_corrections,
    "launch": look_at_launch,
    "learning": look_at_learning,
}


@pytest.mark.parametrize("name", [name for name in _LOOKS if "map" not in name])
def test_a_file_of_then_says_what_it_said(name: str, tmp_path: Path) -> None:
    assert differences(read("files")[name], _LOOKS[name](tmp_path)) == []


@pytest.mark.parametrize("name", ["map", "map_coarse"])
def test_a_map_of_then_is_the_same_map(name: str, tmp_path: Path) -> None:
    then, now = read("files")[name], _LOOKS[name](tmp_path)
    surface, found = then.pop("surface"), now.pop("surface")
    assert differences(then, now) == []  # what is stored, bit for bit
    assert (found["points"], found["labels"]) == (surface["points"], surface["labels"])
    for key in ("least", "most", "mean", "confidence"):
        np.testing.assert_allclose(found[key], surface[key], atol=POINT_M, rtol=0)


def test_what_a_killed_mapper_leaves_can_be_asked(tmp_path: Path) -> None:
    """A folder with the map that was saved while mapping, and no summary."""
    shutil.copyfile(MAP, tmp_path / "map.npz")
    for arguments in (("info", tmp_path), ("query", tmp_path, "nearest", "wall", "0", "0", "1")):
        ran = api.run_here(*arguments)
        assert ran.code == 0, ran.stderr
    ran = api.run_here("eval", tmp_path, "--against", STORED)
    assert ran.code == 0, ran.stdout


def test_corrections_of_then_move_the_map(tmp_path: Path) -> None:
    moved = tmp_path / "moved.tum"  # the whole path half a metre further along x
    rows = [line.split() for line in CORRECTIONS.read_text().splitlines() if not line.startswith("#")]
    moved.write_text("".join(f"{r[0]} {float(r[1]) + 0.5} {' '.join(r[2:])}\n" for r in rows))
    settings = ("--weights", WEIGHTS, "--voxel-size", "0.1", "--max-frames", "4")
    means = []
    for n, corrections in enumerate((CORRECTIONS, moved)):
        out = tmp_path / str(n)
        ran = api.run_here("map", LOG, "--out", out, *settings, "--corrections", corrections)
        assert ran.code == 0, ran.stderr
        means.append(VoxelMap.load(out / "map.npz").points().xyz.mean(0))
    np.testing.assert_allclose(means[1] - means[0], (0.5, 0, 0), atol=1e-3)  # five whole voxels


def test_a_stored_run_of_then_is_what_the_plugin_gets(tmp_path: Path) -> None:
    replays = LogReplays(FOLDER, lambda name: tmp_path / name)
    made = replays("room.mcap", weights="small.safetensors", config=STORED_SETTINGS, max_frames=STORED_FRAMES)
    # Rays at depth borders are sampled elsewhere since priors follow the image's edges (docs/decisions/0020).
    made.assert_like("stored", labels=0.02, score=0.03)
    assert made.mapped == STORED_FRAMES and made.refused == []
    fewer = replays("room.mcap", weights="small.safetensors", config=STORED_SETTINGS, max_frames=STORED_FRAMES - 1)
    with pytest.raises(AssertionError, match="is not as"):
        fewer.assert_like("stored", labels=0.02, score=0.03)
