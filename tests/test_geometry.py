import dataclasses

import cv2
import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.geometry import (
    align_similar,
    check_pose,
    expect_shape,
    invert_pose,
    look_at,
    make_pose,
    project,
    scale_intrinsics,
    select_views,
    transform,
    unproject,
)
from semantic_mapper.rays import invert_pose_torch, pixel_grid, pixel_rays
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(fx=100, fy=200, cx=10, cy=20, width=32, height=24)

finite = st.floats(-50, 50, allow_nan=False)
vectors = hnp.arrays(np.float64, 3, elements=finite)


@st.composite
def poses(draw: st.DrawFn) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(draw(hnp.arrays(np.float64, 3, elements=st.floats(-4, 4))))[0]
    T[:3, 3] = draw(vectors)
    return T


@st.composite
def cameras(draw: st.DrawFn) -> CameraIntrinsics:
    width, height = draw(st.integers(2, 40)), draw(st.integers(2, 40))
    focal = st.floats(0.2, 20)  # image sides
    return CameraIntrinsics(
        fx=draw(focal) * width,
        fy=draw(focal) * height,
        cx=draw(st.floats(0, 1)) * (width - 1),
        cy=draw(st.floats(0, 1)) * (height - 1),
        width=width,
        height=height,
    )


# Shapes


@pytest.mark.parametrize(
    ("shape", "pattern"), [((2, 4), "M 3"), ((2, 3), "M 3 H"), ((2, 3, 4), "M 3"), ((3, 4), "N N")]
)
def test_expect_shape_shows_expected_and_actual(shape: tuple[int, ...], pattern: str) -> None:
    with pytest.raises(ShapeError) as caught:
        expect_shape(torch.zeros(shape), pattern, "rays")
    assert str(caught.value) == f"rays: expected shape ({', '.join(pattern.split())}), got {shape}"


# Poses


@given(T_a_b=poses(), p_b=hnp.arrays(np.float64, (5, 3), elements=finite))
def test_a_pose_and_its_inverse_cancel(T_a_b: np.ndarray, p_b: np.ndarray) -> None:
    np.testing.assert_allclose(T_a_b @ invert_pose(T_a_b), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(transform(invert_pose(T_a_b), transform(T_a_b, p_b)), p_b, atol=1e-9)
    np.testing.assert_allclose(invert_pose_torch(torch.from_numpy(T_a_b)).numpy(), invert_pose(T_a_b), atol=1e-12)


def test_the_inverse_of_a_pose_can_be_differentiated() -> None:
    T = torch.from_numpy(look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0.0, 0, 1]))).requires_grad_()
    assert torch.autograd.gradcheck(invert_pose_torch, (T,))


@given(T=poses())
def test_every_rigid_pose_passes(T: np.ndarray) -> None:
    assert check_pose(T, "frame 1") is None
    assert check_pose(np.round(T, 6), "frame 1") is None  # as a text log stores it


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda T: T * np.nan, "NaN"),
        (lambda T: T + np.diag([0, 0, 0, np.inf]), "NaN or infinity"),
        (lambda T: T @ np.diag([1, 1, -1, 1]), "mirror"),
        (lambda T: T @ np.diag([1.01, 1.01, 1.01, 1]), "not a rotation"),
        (lambda T: T.T, "last row"),
        (lambda T: T * 0, "last row"),
        (lambda T: np.vstack((T[:3] * 0, T[3])), "not a rotation"),
        (lambda T: T + np.diag([0, 0, 1e300], 1), "nearer origin"),
    ],
)
def test_what_is_not_a_rigid_pose_is_refused_by_name(mistake, says: str) -> None:  # type: ignore[no-untyped-def]
    T = look_at(np.array([1.0, 2, 3]), np.zeros(3), np.array([0.0, 0, 1]))
    with pytest.raises(PoseError, match=says) as caught:
        check_pose(mistake(T), "frame 12 of log.mcap")
    assert "frame 12 of log.mcap" in str(caught.value)


@given(eye=vectors, target=vectors)
def test_look_at_puts_the_target_in_the_middle_and_up_on_top(eye: np.ndarray, target: np.ndarray) -> None:
    up = np.array([0.0, 0, 1])
    assume(np.linalg.norm(np.cross(target - eye, up)) > 1e-3)
    T_world_camera = look_at(eye, target, up)
    check_pose(T_world_camera, "look_at")
    p_camera = transform(invert_pose(T_world_camera), target)
    np.testing.assert_allclose(p_camera, [0, 0, np.linalg.norm(target - eye)], atol=1e-6)
    assert T_world_camera[:3, 1] @ up < 0  # y points down


# Cameras


def test_projection_by_hand() -> None:
    p = np.array([[0, 0, 1], [0.1, 0.2, 2], [-1, -0.5, 4]], np.float64)
    np.testing.assert_allclose(project(p, CAMERA), [[10, 20], [15, 40], [-15, -5]])


@given(camera=cameras(), seed=st.integers(0, 1000))
def test_unprojected_pixels_project_onto_themselves(camera: CameraIntrinsics, seed: int) -> None:
    depth = np.random.default_rng(seed).uniform(0.2, 10, (camera.height, camera.width)).astype(np.float32)
    points = unproject(depth, camera)
    assert points.shape == (camera.height, camera.width, 3)
    np.testing.assert_array_equal(points[..., 2], depth)
    pixels = project(points.reshape(-1, 3), camera)
    np.testing.assert_allclose(pixels, pixel_grid(camera.width, camera.height).numpy(), atol=1e-6)


@given(camera=cameras(), width=st.integers(1, 80), height=st.integers(1, 80))
def test_scaled_intrinsics_see_the_same_corners_and_scale_back(
    camera: CameraIntrinsics, width: int, height: int
) -> None:
    scaled = scale_intrinsics(camera, width, height)
    # Outer edges of the image, half a pixel beyond the outermost centres, stay where they were in the scene.
    for old, new in (
        ((-0.5, -0.5), (-0.5, -0.5)),
        ((camera.width - 0.5, camera.height - 0.5), (width - 0.5, height - 0.5)),
    ):
        assert (new[0] - scaled.cx) / scaled.fx == pytest.approx((old[0] - camera.cx) / camera.fx, abs=1e-9)
        assert (new[1] - scaled.cy) / scaled.fy == pytest.approx((old[1] - camera.cy) / camera.fy, abs=1e-9)
    back = scale_intrinsics(scaled, camera.width, camera.height)
    assert dataclasses.astuple(back)[:6] == pytest.approx(dataclasses.astuple(camera)[:6], abs=1e-9)


# Alignment


def test_alignment_is_the_best_there_is(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    best, scale = align_similar(a, b)

    def cost(T: np.ndarray, scale: float) -> float:
        return float(((scale * a @ T[:3, :3].T + T[:3, 3] - b) ** 2).sum())

    assert np.allclose(best[:3, :3] @ best[:3, :3].T, np.eye(3)) and np.linalg.det(best[:3, :3]) > 0
    for _ in range(300):
        other = best @ make_pose(rng.normal(0, 0.02, 3), rng.normal(0, 0.02, 3))
        assert cost(other, scale * rng.uniform(0.97, 1.03)) >= cost(best, scale)


def test_alignment_finds_the_similarity_and_refuses_a_single_place(rng: np.random.Generator) -> None:
    a, T = rng.normal(size=(30, 3)), make_pose((0.3, -2.0, 1.1), (5, -3, 2))
    found, scale = align_similar(a, 2.5 * a @ T[:3, :3].T + T[:3, 3])
    assert scale == pytest.approx(2.5) and np.allclose(found, T)
    with pytest.raises(ShapeError, match="not all one"):
        align_similar(np.ones((5, 3)), a[:5])
    for some, others in ((a[:5], a[:4]), (a[:2], a[:2])):
        with pytest.raises(ShapeError, match="as many points"):
            align_similar(some, others)


# Rays


@given(camera=cameras(), T_world_camera=poses(), seed=st.integers(0, 1000))
def test_every_point_of_a_ray_projects_to_its_pixel_at_its_depth(
    camera: CameraIntrinsics, T_world_camera: np.ndarray, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0, 0), (camera.width, camera.height), (6, 2))
    z = rng.uniform(0.3, 8, 6)
    rays = pixel_rays(torch.from_numpy(pixels), camera, torch.from_numpy(T_world_camera), near_m=0.1, far_m=9)
    p_world = (rays.origin + torch.from_numpy(z)[:, None] * rays.direction).numpy()
    p_camera = transform(invert_pose(T_world_camera), p_world)
    np.testing.assert_allclose(p_camera[:, 2], z, rtol=1e-9)
    np.testing.assert_allclose(project(p_camera, camera), pixels, atol=1e-6)


# Choosing views

EVEN = np.ones(3)
NOTHING = np.zeros(3)


def test_views_are_chosen_for_what_they_add():
    seen = np.array([[1, 1, 1, 0, 0], [1, 1, 0, 0, 0], [0, 0, 0, 1, 1]], bool)
    assert select_views(seen, EVEN, NOTHING, 2) == [0, 2]
    assert select_views(seen, EVEN, NOTHING, 9) == [0, 2, 1], "a second look at the same points is worth something"


def test_what_sees_nothing_is_never_chosen():
    seen = np.array([[1, 0], [0, 0], [0, 0]], bool)
    assert select_views(seen, EVEN, np.full(3, 5.0), 3) == [0]
    assert select_views(np.zeros((3, 4), bool), EVEN, EVEN, 3) == []
    assert select_views(np.zeros((3, 0), bool), EVEN, EVEN, 3) == []
