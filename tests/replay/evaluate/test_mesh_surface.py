import numpy as np
import pytest

from semantic_mapper.errors import MapError
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.mesh_surface import compare_with_mesh
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.small import tiny_config

INTRINSICS = CameraIntrinsics(80.0, 80.0, 47.5, 35.5, 96, 72)
WALL_M = 1.5


@pytest.fixture
def wall_folder(tmp_path):
    """The map of a wall at z = 1.5 m, all of it labelled as the first class."""
    voxel_map = VoxelMap(tiny_config(voxel_map={"voxel_size_m": 0.02}).voxel_map, ROOMS)
    depth = np.full((72, 96), WALL_M, np.float32)
    rgb = np.full((72, 96, 3), 128, np.uint8)
    probabilities = np.zeros((72, 96, len(ROOMS)), np.float32)
    probabilities[..., 0] = 1
    frame = PosedFrame(1, 0, "c", rgb, depth, None, INTRINSICS, np.eye(4))
    for _ in range(3):
        voxel_map.integrate(frame, depth, probabilities, np.ones((72, 96), bool))
    voxel_map.save(tmp_path / "map.npz")
    return tmp_path


def write_wall(path, z: float, half: float = 0.5, label: int = ROOMS.ids[0]) -> None:
    xs = np.linspace(-half, half, 40)
    grid = np.stack(np.meshgrid(xs, xs), -1).reshape(-1, 2)
    vertices = np.column_stack((grid, np.full(len(grid), z))).astype(np.float32)
    cell = np.add.outer(np.arange(39) * 40, np.arange(39)).ravel()
    faces = np.concatenate((np.stack((cell, cell + 1, cell + 40), 1), np.stack((cell + 1, cell + 41, cell + 40), 1)))
    np.savez(path, vertices=vertices, faces=faces.astype(np.int32), label=np.full(len(grid), label, np.uint8))


def test_walls_are_as_far_off_and_as_complete_as_they_are(wall_folder):
    for off_m, half, wanted in (
        (0.0, 0.5, {"complete": 1.0, "mesh_miou": 1.0}),
        (0.07, 0.5, {"complete": 0.0, "complete_10cm": 1.0}),
        (0.0, 1.5, {}),
        (0.03, 1.5, {}),
    ):
        write_wall(wall_folder / "mesh.npz", WALL_M + off_m, half)
        found = compare_with_mesh(wall_folder, wall_folder / "mesh.npz")
        assert {name: found[name] for name in wanted} == wanted
        assert wanted or abs(found["median_m"] - off_m) < 0.003


def test_what_was_never_seen_is_not_complete_wrong_labels_score_zero_and_no_mesh_is_named(wall_folder):
    write_wall(wall_folder / "mesh.npz", WALL_M, half=2.0, label=ROOMS.ids[1])
    found = compare_with_mesh(wall_folder, wall_folder / "mesh.npz")
    assert found["complete"] < found["complete_10cm"] < 0.5 and found["mesh_miou"] == 0.0

    (wall_folder / "mesh.npz").write_bytes(b"nonsense")
    with pytest.raises(MapError, match=r"mesh\.npz"):
        compare_with_mesh(wall_folder, wall_folder / "mesh.npz")
