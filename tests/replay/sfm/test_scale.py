from dataclasses import replace

import msgspec
import numpy as np
import pytest

from semantic_mapper.bundle.scale import find_floor
from semantic_mapper.config import MapperConfig, convert_config, to_plain
from semantic_mapper.drivers.poses.board import BoardFinder, make_board
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, look_at, make_pose, project, transform
from semantic_mapper.replay.sfm.scale import fit_to_scene, scale_by_board, scene_depth, vertical
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

CAMERA = CameraIntrinsics(300.0, 300.0, 159.5, 119.5, 320, 240, (0.05, 0.0, 0.0, 0.0))
UP = np.eye(3)[2]


def test_the_floor_is_the_lowest_layer_never_a_table(rng: np.random.Generator) -> None:
    def layer(count: int, z: float, noise: float = 0.01) -> Float64:
        return np.column_stack((rng.uniform(-1, 1, (count, 2)), rng.normal(z, noise, count)))

    camera, floor, table = np.array((0.0, 0.0, 1.5)), layer(200, 0.0), layer(3000, 0.75)
    room = np.concatenate((floor, table, layer(9, -0.5, 0.2), layer(300, 1.2, 0.25)))
    tilted = make_pose(np.radians((7, -6, 50)), np.zeros(3))[:3, :3]
    for turn, cone_deg in ((np.eye(3), 0.0), (tilted, 12.0)):
        found = find_floor((room - camera) @ turn.T, np.zeros(3), UP, cone_deg)
        assert found is not None and found.below == pytest.approx(1.5, rel=0.01) and not found.unsure
        assert np.degrees(np.arccos(found.up @ turn[:, 2])) < 0.5
    slope = np.column_stack((rng.uniform(-1, 1, (900, 2)), 1.2 * rng.uniform(0.3, 1, 900) ** 0.5))
    for points in (np.concatenate((table, layer(60, 0.3, 0.2))), table + 2 * UP, floor[:15], slope):
        assert find_floor(points, camera, UP) is None
    few = find_floor(floor[:60], camera, UP)
    assert few is not None and few.unsure


def test_up_is_where_upright_edges_meet(rng: np.random.Generator) -> None:
    poses = {n: look_at(np.array((0.3 * n, 0, 1.5)), np.array((0.3 * n + rng.normal(), 3, 0.9)), UP) for n in range(8)}
    edges: dict[int, Float64] = {}
    plain = CameraIntrinsics(300.0, 300.0, 159.5, 119.5, 320, 240)
    for n, T in poses.items():
        rows = []
        for kind in range(40):
            a = np.array((rng.uniform(-2, 4), 3.0, rng.uniform(0.3, 1.2)))
            b = a + ((0, 0, 0.8) if kind % 4 == 0 else rng.normal(0, 0.5, 3))
            rows.append(project(transform(invert_pose(T), np.stack((a, b))), plain).ravel())
        edges[n] = np.stack(rows)
    guess = np.array((0.3, -0.3, 1.0))
    found = vertical(edges, poses, plain, guess)
    assert found is not None and np.degrees(np.arccos(found @ UP)) < 0.3
    # A lens that folds has no ray for the picture's corner.
    slopes = {n: (rows.reshape(-1, 2, 2) - (159.5, 119.5)) / 300 for n, rows in edges.items()}
    inner = {n: at[(np.linalg.norm(at, axis=2) < 0.7).all(axis=1)] for n, at in slopes.items()}
    bent = {n: 300 * at * (1 - 0.5 * (at**2).sum(axis=2, keepdims=True)) + (159.5, 119.5) for n, at in inner.items()}
    with_corner = {n: np.concatenate((at.reshape(-1, 4), [(0.0, 0.0, 1.0, 30.0)])) for n, at in bent.items()}
    found = vertical(with_corner, poses, replace(plain, distortion=(-0.5, 0.0, 0.0, 0.0)), guess)
    assert found is not None and np.degrees(np.arccos(found @ UP)) < 0.3
    random = {n: rng.uniform(0, 240, (40, 4)) for n in poses}
    assert vertical({0: random[0][:5]}, poses, plain, guess) is None


def board_view(T_board_camera: Float64, config: BoardPoses, camera: CameraIntrinsics) -> UInt8:
    """A picture of the board by a camera at a pose in the board's world."""
    import cv2

    a_metre = 2000
    size = (round(config.columns * config.square_m * a_metre), round(config.rows * config.square_m * a_metre))
    sheet = make_board(config).generateImage(size, marginSize=0)
    T = invert_pose(T_board_camera)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.array([[1 / a_metre, 0, 0.5 / a_metre], [0, 1 / a_metre, 0.5 / a_metre], [0, 0, 0], [0, 0, 1]])
    homography = K @ T[:3] @ pixels
    options = {"flags": cv2.INTER_AREA, "borderMode": cv2.BORDER_CONSTANT, "borderValue": 180}
    view = cv2.warpPerspective(sheet, homography, (camera.width, camera.height), **options)
    return np.ascontiguousarray(np.repeat(np.asarray(view, np.uint8)[:, :, None], 3, axis=2))


def test_a_board_tells_the_scale() -> None:
    config = BoardPoses()
    camera = CameraIntrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
    finder, seen, scaled, poses = BoardFinder(config), [], 3.0, {}
    middle = np.array((0.14, 0.1, 0.0))
    for n in range(5):
        T = look_at(middle + np.array((0.12 * (n - 2), 0.05 * n, -0.5)), middle, np.array((0.0, -1.0, 0.0)))
        seen.append((n, *finder.find(board_view(T, config, camera))))
        poses[n] = T.copy()
        poses[n][:3, 3] /= scaled
    found, how = scale_by_board(seen, poses, camera)
    assert found == pytest.approx(scaled, rel=0.01) and "board" in how
    with pytest.raises(ImportSourceError, match="board tells no scale"):
        scale_by_board(seen, {0: poses[0]}, camera)
    beyond = [(n, points, np.zeros_like(pixels)) for n, points, pixels in seen]  # the fold of a lens
    with pytest.raises(ImportSourceError, match="board tells no scale"):
        scale_by_board(beyond, poses, replace(camera, distortion=(-0.9, 0.0, 0.0, 0.0)))


def test_ranges_follow_a_scene_that_is_larger_than_a_room_and_given_settings_stay() -> None:
    usual = MapperConfig()
    for metadata in ({}, scene_depth(3.9), *({"scene_depth": text} for text in ("far", "nan", "inf", "-1"))):
        assert fit_to_scene(usual, StreamInfo("film", metadata=metadata)) == (usual, "")
    far, _ = fit_to_scene(usual, StreamInfo("film", metadata=scene_depth(5000.0)))
    assert convert_config(to_plain(far), MapperConfig, "far") == far
    street = StreamInfo("film", metadata=scene_depth(20.0))
    fitted, said = fit_to_scene(usual, street)
    assert (fitted.voxel_map.voxel_size_m, fitted.voxel_map.depth_max_m) == (0.2, 50)
    assert (fitted.depth.from_motion.near_m, fitted.depth.from_motion.far_m) == (4, 80)
    assert "up to 50 m in voxels of 0.2 m" in said
    given = msgspec.structs.replace(usual, voxel_map=msgspec.structs.replace(usual.voxel_map, voxel_size_m=0.1))
    assert fit_to_scene(given, street)[0].voxel_map.voxel_size_m == 0.1
