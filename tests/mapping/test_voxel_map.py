from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError, FrameError, MapError, ShapeError
from semantic_mapper.geometry import look_at
from semantic_mapper.mapping.blocks import unpack_keys
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.queries.surface import cast_rays
from semantic_mapper.types import CameraIntrinsics
from tests.mapping.rendered_views import (
    INTRINSICS,
    LABELS,
    around,
    frame,
    plane_depth,
    ray_directions,
    small_map,
    sphere_depth,
    sure,
)

State = dict[str, NDArray[np.generic]]
CENTER = np.array([0.3, -0.2, 0.5])
OBLIQUE = look_at(np.array([0.4, -0.3, -1.1]), np.array([0.1, 0.1, 0.4]), np.array([0.1, -1.0, 0.0]))


def same(a: State, b: State) -> bool:
    return a.keys() == b.keys() and all(a[k].shape == b[k].shape and (a[k] == b[k]).all() for k in a)


def fuse_sphere(voxel_map: VoxelMap, count: int = 6) -> None:
    for seq, pose in enumerate(around(CENTER, 1.2, count)):
        depth = sphere_depth(pose, CENTER, 0.4)
        voxel_map.integrate(frame(pose, seq=seq), depth, sure(seq % 3, 0.6), depth > 0)


def open3d_state(voxel_map: VoxelMap, depth: NDArray[np.float32], rgb: NDArray[np.uint8], pose: NDArray[np.float64]):
    """What Open3D's own integrate makes of one frame in the same blocks: tsdf, weight, colour in the same layout."""
    o3d = load_open3d()
    core, config = o3d.core, voxel_map.config
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (core.float32,) * 3,
        ((1,), (1,), (3,)),
        config.voxel_size_m,
        8,
        1000,
        core.Device("CPU:0"),
    )
    i = INTRINSICS
    K = core.Tensor(np.array([[i.fx, 0, i.cx + 0.5], [0, i.fy, i.cy + 0.5], [0, 0, 1]]))
    images = [o3d.t.geometry.Image(core.Tensor(a)) for a in (depth, rgb.astype(np.float32) / 255)]
    keys = core.Tensor(np.ascontiguousarray(voxel_map.block_state()["keys"]))
    grid.integrate(
        keys, *images, K, K, core.Tensor(np.linalg.inv(pose)), 1.0, config.depth_max_m, config.truncation_voxels
    )
    found, _ = grid.hashmap().find(keys)
    return [grid.attribute(name).numpy()[found.numpy()] for name in ("tsdf", "weight", "color")]


@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_tsdf_and_colour_equal_open3ds_own_integrate(shape: str) -> None:
    voxel_map = small_map()
    pose = OBLIQUE if shape == "plane" else around(CENTER, 1.2, 5)[1]
    depth = plane_depth(pose, (0.2, 0.1, 1.0), 0.45) if shape == "plane" else sphere_depth(pose, CENTER, 0.4)
    posed = frame(pose, rgb=None if shape == "plane" else 77)
    voxel_map.integrate(posed, depth, None, None)
    tsdf, weight, color = open3d_state(voxel_map, depth, posed.rgb, pose)
    mine = voxel_map.block_state()
    both = (mine["weight"] > 0) & (weight[..., 0] > 0)
    # Open3D leaves out the outer half of the border pixels, and single voxels fall to the other pixel by rounding.
    assert both.sum() > 0.95 * (mine["weight"] > 0).sum() and both.sum() > 0.999 * (weight > 0).sum()
    difference = np.abs(mine["tsdf"] - tsdf[..., 0])[both]
    assert (difference > 1e-3).mean() < 1e-4 and np.quantile(difference, 0.999) < 1e-5
    if shape == "plane":  # on the sphere's rim a neighbouring pixel is another surface
        assert difference.max() < 0.05 and np.quantile(np.abs(mine["color"] - color)[both], 0.999) < 0.01


def test_what_the_map_is_unsure_of_is_unknown_wherever_it_is_read(tmp_path: Path) -> None:
    """Left half of the view p = 0.5, right half p = 0.9; threshold between the two."""
    probabilities = np.concatenate((sure(2, 0.5)[:, :80], sure(1, 0.9)[:, 80:]), axis=1)
    plain, strict = small_map(), small_map(unknown_below=0.7)
    for voxel_map in (plain, strict):
        voxel_map.integrate(frame(), np.full((120, 160), 1.0, np.float32), probabilities, None)
    assert same(plain.block_state(), strict.block_state()), "the evidence is the same, only its reading is not"
    strict.save(tmp_path / "map.npz")
    strict = VoxelMap.load(tmp_path / "map.npz")
    at_voxels = [MapMirror.of(voxel_map).snapshot() for voxel_map in (plain, strict)]
    readings = [
        (plain.points(), strict.points()),
        (plain.mesh(), strict.mesh()),
        (plain.ray_cast(np.eye(4), INTRINSICS), strict.ray_cast(np.eye(4), INTRINSICS)),
        (plain.changes(0), strict.changes(0)),
        tuple(cast_rays(s, (0, 0, 0), ray_directions(INTRINSICS, np.eye(4)).reshape(-1, 3)) for s in at_voxels),
    ]
    for free, reading in readings:
        np.testing.assert_array_equal(reading.confidence, free.confidence)
        unsure = reading.confidence < (0.7 if reading.confidence.dtype == np.float32 else round(0.7 * 255))
        assert (free.label[unsure & (free.confidence > 0)] != LABELS.ignore_id).sum() > 50
        np.testing.assert_array_equal(reading.label, np.where(unsure, LABELS.ignore_id, free.label))
        assert set(np.unique(reading.label)) == {LABELS.ignore_id, 9}
    seen = strict.to_open3d().attribute("label").numpy()
    assert set(np.unique(seen).tolist()) == {LABELS.ignore_id, 9}


@pytest.mark.parametrize("wrong", [np.nan, -0.5, 3.0])
def test_what_is_no_probability_is_refused_and_changes_nothing(wrong: float) -> None:
    voxel_map = small_map()
    probabilities = sure(0)
    probabilities[60, 80, 1] = wrong
    depth = np.ones((120, 160), np.float32)
    with pytest.raises(FrameError, match="1 known pixels"):
        voxel_map.integrate(frame(), depth, probabilities, None)
    assert voxel_map.block_count == 0
    known = np.ones((120, 160), bool)
    known[60, 80] = False
    assert voxel_map.integrate(frame(), depth, probabilities, known) > 0


def test_frames_that_cannot_be_fused_are_refused_by_name() -> None:
    voxel_map, depth = small_map(), np.ones((120, 160), np.float32)
    far = np.eye(4)
    far[0, 3] = 1e7
    distorted = CameraIntrinsics(130, 130, 80, 60, 160, 120, (0.1, 0.0, 0.0, 0.0))
    no_bool = np.ones((120, 160), np.uint8)
    refused: list[tuple[tuple, type[Exception], str]] = [
        ((frame(), depth[:60], None), ShapeError, "depth_m"),
        ((frame(), depth.astype(np.float64), None), ShapeError, r"depth_m.*float32"),
        ((frame(), depth, sure(0)[..., :2]), ShapeError, "probabilities"),
        ((frame(), depth, sure(0), no_bool), ShapeError, "known"),
        ((frame(intrinsics=distorted), depth, None), FrameError, "rectified"),
        ((frame(far), depth, None), FrameError, "origin"),
    ]
    for arguments, error, message in refused:
        with pytest.raises(error, match=message):
            voxel_map.integrate(*arguments)
    assert voxel_map.block_count == 0


def test_a_full_map_refuses_and_stays_usable() -> None:
    voxel_map = small_map(max_blocks=150)
    voxel_map.integrate(frame(), plane_depth(np.eye(4), (0, 0, 1), 0.8), sure(0), None)
    before, count = voxel_map.block_state(), voxel_map.block_count
    with pytest.raises(MapError, match=r"max_blocks"):
        voxel_map.integrate(frame(seq=1), np.full((120, 160), 3.0, np.float32), sure(0), None)
    assert voxel_map.block_count == count and same(before, voxel_map.block_state())
    assert voxel_map.integrate(frame(seq=2), plane_depth(np.eye(4), (0, 0, 1), 0.8), sure(0), None) == count
    assert len(voxel_map.points().xyz) > 1000 and voxel_map.frames == 2


def test_a_map_knows_which_frame_saw_a_block_last(monkeypatch: pytest.MonkeyPatch) -> None:
    voxel_map, away = small_map(), np.diag([-1.0, 1.0, -1.0, 1.0])
    stamps = list[int]()
    for seq, pose in enumerate((np.eye(4), away, away)):
        posed = frame(pose, seq=seq)
        voxel_map.integrate(posed, np.full((120, 160), 1.0, np.float32), sure(0), None)
        stamps.append(posed.stamp_ns)
    packed, seen = voxel_map.changed_stamps(0)
    z = np.asarray(unpack_keys(packed)[:, 2], np.int64)
    assert set(seen[z > 0]) == {stamps[0]} and set(seen[z < -1]) == {stamps[2]}
    monkeypatch.setattr("semantic_mapper.mapping.voxel_map.MAX_STAMPS", 2)
    voxel_map.integrate(frame(seq=9), np.full((120, 160), 1.0, np.float32), sure(0), None)
    assert voxel_map.changed_stamps(voxel_map.version - 1)[1].max() == voxel_map.last_stamp_ns


def test_same_frames_give_the_same_bits_on_one_thread_and_on_two() -> None:
    maps = [small_map(), small_map(), small_map()]
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        fuse_sphere(maps[0])
        fuse_sphere(maps[1])
        torch.set_num_threads(1)
        fuse_sphere(maps[2])
    finally:
        torch.set_num_threads(before)
    states = [m.block_state() for m in maps]
    assert same(states[0], states[1]) and same(states[0], states[2])
    assert (maps[0].points().xyz == maps[2].points().xyz).all()


def test_readers_in_other_threads_meet_no_half_grown_map() -> None:
    voxel_map = small_map()
    done, failures = threading.Event(), []

    def read() -> None:
        while not done.is_set():
            try:
                view = voxel_map.ray_cast(np.eye(4), CameraIntrinsics(20, 20, 12, 9, 24, 18))
                if not np.isfinite(view.depth_m).all():
                    failures.append("depth")
            except Exception as error:  # noqa: BLE001  (whatever it is, the test has to fail in its own thread)
                failures.append(repr(error))

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for seq in range(12):
        voxel_map.integrate(frame(seq=seq), np.full((120, 160), 0.6 + 0.3 * seq, np.float32), sure(0), None)
    done.set()
    for reader in readers:
        reader.join()
    assert not failures


def test_impossible_configurations_are_refused_by_name() -> None:
    for change in ({"voxel_size_m": 0.0}, {"depth_max_m": np.nan}):
        with pytest.raises(ConfigError, match=next(iter(change))):
            VoxelMap(VoxelMapConfig(**change), LABELS)
    with pytest.raises(MapError, match="this machine has"):
        small_map(memory_mb=10**9, max_blocks=10**8)
    with pytest.raises(MapError, match="min_weight"):
        small_map().points(0)
