"""What ``bench`` measures, on a few frames of the log that ships."""

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.config import MapperConfig, VoxelMapConfig, with_quality
from semantic_mapper.replay.bench import bench_fusion, bench_pipeline
from semantic_mapper.replay.log import demo_log
from semantic_mapper.replay.peers.comparison import compare_peers, drift, write_peers
from semantic_mapper.replay.peers.worker import Frame, Setup, octomap, small_gicp
from semantic_mapper.types import CameraIntrinsics
from tests.contract.golden import form, undocumented
from tests.drawn_room import truth_of, walk_frames


def test_fusion_is_measured_against_open3d() -> None:
    found = bench_fusion(demo_log(), frames=1, voxel_size_m=0.08, repeats=2)
    middle, low, high = found["ratio_20"]
    assert low <= middle <= high and middle == pytest.approx(found["ms_20"] / found["open3d_ms"], rel=0.5)
    assert min(found["ratio_40"]) > 0 and found["frames"] == 1
    assert found["blocks"] >= 0.9 * found["open3d_blocks"] > 0  # Open3D looks at every fourth pixel


def test_pipeline_reports_its_rate_its_stages_and_what_the_labels_are_worth() -> None:
    found = bench_pipeline(demo_log(), None, with_quality(MapperConfig(quality="fast")), frames=1)
    assert undocumented("bench", form(found)) == []
    assert found["hz"] > 0 and found["p95_ms"] >= found["p50_ms"]
    assert {"encode", "render", "fuse"} <= set(found["stages_ms"])
    assert sum(found["stages_ms"].values()) <= found["p95_ms"] * 1.05
    assert 0.1 < found["miou"] <= 1


def test_peers_are_measured_on_the_same_frames_and_one_that_is_absent_names_what_brings_it(tmp_path: Path) -> None:
    frames = walk_frames(1, 5, CameraIntrinsics(130.0, 130.0, 80.0, 60.0, 160, 120))
    np.savez(mesh := tmp_path / "mesh.npz", vertices=np.eye(3), faces=np.arange(3)[None])
    names = ("ours-no-classes", "open3d", "ours-odometry", "vdbfusion")
    found = compare_peers(frames, VoxelMapConfig(voxel_size_m=0.05), truth=mesh, names=names, repeats=1)
    ours, open3d, odometry, absent = found["peers"]
    for row in found["peers"]:
        assert undocumented("bench", form({**found, "peers": [row]})) == []
    assert ours["cpu_ms"][0] > 0 and open3d["peak_mb"] > ours["peak_mb"] > ours["loaded_mb"] > 0
    assert ours["ghosts"] < 0.1 < 0.9 < open3d["ghosts"]  # Open3D does not see through its surfaces
    assert odometry["lost"] == 0 and odometry["ate_m"] < 0.02
    assert "vdbfusion" in absent["problem"] and "uv pip install" in absent["install"]
    write_peers(tmp_path, found)
    assert (tmp_path / "peers.png").stat().st_size > 1000


def test_points_of_octomap_lie_at_the_centres_of_its_voxels() -> None:
    pytest.importorskip("pyoctomap", reason="the extra `peers`")
    setup = Setup(30.0, 30.0, 15.5, 11.5, 32, 24, voxel_size_m=0.05, truncation_m=0.2, depth_max_m=5.0)
    wall = np.full((24, 32), 1.02, np.float32)  # within the voxels from 1.00 to 1.05 m
    mapper = octomap(setup)
    assert mapper.points is not None
    mapper.add(mapper.prepare(Frame(0, np.zeros((24, 32, 3), np.uint8), wall, np.eye(4))))
    points = np.asarray(mapper.points())
    assert len(points) > 50 and points[:, 2] == pytest.approx(1.025, abs=1e-6)
    assert points / 0.05 - 0.5 == pytest.approx(np.round(points / 0.05 - 0.5), abs=1e-4)
    assert np.abs(points[:, :2].mean(0)).max() < 0.005  # as the wall does, they lie round the axis


def test_small_gicp_is_lost_where_no_point_has_a_match_although_it_says_converged() -> None:
    pytest.importorskip("small_gicp", reason="the extra `peers`")
    peer = small_gicp(Setup(30.0, 30.0, 15.5, 11.5, 32, 24, voxel_size_m=0.05, truncation_m=0.2, depth_max_m=5.0))
    found = []
    for depth_m in (1.0, 4.0, 1.0):
        depth = np.full((24, 32), depth_m, np.float32)
        found.append(peer.add(peer.prepare(Frame(0, np.zeros((24, 32, 3), np.uint8), depth, np.eye(4)))))
    assert found[1] is None
    for pose in (found[0], found[2]):
        np.testing.assert_allclose(pose, np.eye(4), atol=1e-3)


def test_drift_is_the_error_of_motions_and_of_aligned_positions() -> None:
    poses = truth_of(walk_frames(1, 5, CameraIntrinsics(13.0, 13.0, 8.0, 6.0, 16, 12)))
    assert drift(poses, np.linalg.inv(poses[0]) @ poses) == {"lost": 0, "rpe_m": 0.0, "rpe_deg": 0.0, "ate_m": 0.0}
    off = poses.copy()
    off[1, :3, 3] += 0.01  # wrong by 17.3 mm in two of three motions
    off[4] = np.nan
    assert drift(poses, off)["rpe_m"] == pytest.approx(0.01 * np.sqrt(2), abs=1e-5) and drift(poses, off)["lost"] == 1
