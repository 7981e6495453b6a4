"""Fitting grids: to images, from depth, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import structlog
import torch

from research.experiments.grid_scenes import BOX_M, object_frames, objects_scene
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.registry import build_field
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig
from semantic_mapper.training.frame_rays import frame_rays
from semantic_mapper.training.grid_fit import distance_to_surface, fit_grid, fit_scene, grid_of_depth, render_frame
from semantic_mapper.training.scene_box import scene_box, sparse_points
from semantic_mapper.types import PosedFrame
from tests.small import tiny_frames

GRID = GridFitConfig(rays=512, long_side=32, box_m=BOX_M, near_m=1.0, exposure=False, held_out=6)
SMALL = FinetuneConfig(seconds=0, steps=150, width=72, grid=GRID)


@cache
def objects(count: int = 24) -> tuple[PosedFrame, ...]:
    """Views round objects before white, without depth."""
    return tuple(object_frames(objects_scene(1), count, 1))


def test_a_fit_renders_views_that_it_has_not_seen_far_better_than_their_mean_colour() -> None:
    losses: list[float] = []
    fit = fit_grid(objects(), SMALL, lambda p: losses.append(p.loss))
    assert fit.steps == len(losses) == 150
    assert fit.psnr > fit.mean_colour_psnr + 6
    assert max(fit.grid.config.shape) == 32


def test_the_same_fit_gives_the_same_bits_on_any_number_of_threads() -> None:
    config = msgspec.structs.replace(SMALL, steps=40, grid=msgspec.structs.replace(GRID, held_out=0))
    before = torch.get_num_threads()
    grids: list[dict[str, torch.Tensor]] = []
    try:
        for threads in (1, 1, 3):
            torch.set_num_threads(threads)
            grids.append(fit_grid(objects(), config).grid.state_dict())
    finally:
        torch.set_num_threads(before)
    for other in grids[1:]:
        assert all(torch.equal(tensor, other[name]) for name, tensor in grids[0].items())


def test_a_grid_of_depth_alone_has_its_surface_where_depth_was_measured() -> None:
    rays = frame_rays(tiny_frames(), 96)
    box = scene_box(tiny_frames(), GridFitConfig(long_side=96))
    grid = grid_of_depth(rays, box)
    _, depth = render_frame(grid, rays, 2, 0.1)
    measured = rays.depth_m[rays.pixels_of(2)].reshape(depth.shape)
    seen = measured > 0
    assert np.median(np.abs(depth - measured)[seen]) < 0.6 * box.voxel_m
    _, observed = distance_to_surface(rays, box)
    assert 0.05 < observed.mean() < 0.95


def test_a_fit_that_starts_from_depth_keeps_it_and_learns_colours() -> None:
    grid = GridFitConfig(rays=512, long_side=64, held_out=0)
    config = FinetuneConfig(seconds=0, steps=120, width=96, grid=grid)
    fit = fit_grid(tiny_frames(), config)
    rays = frame_rays(tiny_frames(), 96)
    colour, depth = render_frame(fit.grid, rays, 2, grid.near_m)
    truth = rays.rgb[rays.pixels_of(2)].reshape(colour.shape) / 255
    measured = rays.depth_m[rays.pixels_of(2)].reshape(depth.shape)
    assert np.median(np.abs(depth - measured)[measured > 0]) < 0.6 * fit.grid.config.voxel_m
    assert np.square(colour - truth).mean() < 0.3 * np.square(truth - truth.mean((0, 1))).mean()


def test_a_scene_fit_gives_weights_that_say_what_they_are() -> None:
    progress = []
    config = msgspec.structs.replace(SMALL, steps=100)
    checkpoint = fit_scene(objects(), ROOMS, None, config, progress.append, seen_stamps_ns=(7,))
    field = checkpoint.model
    assert isinstance(field, GridField) and field.fitted and not field.training
    assert checkpoint.recipe["steps"] == 100 == len(progress) and checkpoint.recipe["train_stamps_ns"] == [7]
    assert checkpoint.recipe["psnr"] > 0 and checkpoint.width == 72


def test_a_trunk_learns_colours_in_the_grids_geometry() -> None:
    progress = []
    field = fit_scene(
        objects(), ROOMS, build_field("grid", {"features": 4, "trunk_width": 16}, ROOMS), SMALL, progress.append
    ).model
    assert isinstance(field, GridField) and field.trunk is not None
    fractions = [p.fraction for p in progress]
    assert len(fractions) == 150 + 150 and fractions == sorted(fractions) and fractions[-1] == 1
    rays = frame_rays(objects(), 72)
    pixels = rays.pixels_of(5)
    with torch.no_grad():
        samples = field.march(rays.rays(pixels, 1.0))
        colour = (samples.weight[..., None] * field.colour(samples)).sum(1)
    solid = samples.opacity > 0.9
    truth = torch.from_numpy(rays.rgb[pixels] / np.float32(255))
    assert solid.sum() > 500 and (colour - truth)[solid].square().mean() < 0.02


def test_poses_that_only_turn_are_refused() -> None:
    still = []
    for frame in objects():
        T = frame.T_world_camera.copy()
        T[:3, 3] = (1.0, 2.0, 3.0)
        still.append(replace(frame, T_world_camera=T))
    with pytest.raises(FrameError, match=r"only turn tell no depth.*T_world_camera, with translations in metres"):
        fit_grid(still, SMALL)


def test_poses_that_do_not_fit_the_images_are_refused() -> None:
    # The camera axes of OpenGL (y up, z backward): every view looks away from the scene.
    axes = np.diag([1.0, -1.0, -1.0, 1.0])
    wrong = [replace(f, T_world_camera=f.T_world_camera @ axes) for f in objects()]
    with pytest.raises(FrameError, match=r"hardly better than by their mean colour.*z forward"):
        fit_grid(wrong, SMALL)


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(FrameError, match="at least 2 frames to fit besides held-out ones, got 1"):
        fit_grid(objects()[:1], SMALL)


def test_frames_with_impossible_poses_are_left_out_and_counted() -> None:
    broken = [replace(f, T_world_camera=np.full((4, 4), np.nan)) for f in objects()[:2]]
    with structlog.testing.capture_logs() as logs:
        fit = fit_grid(
            [*broken, *objects()[2:]],
            msgspec.structs.replace(SMALL, steps=5, grid=msgspec.structs.replace(GRID, held_out=0)),
        )
    assert [entry["count"] for entry in logs if entry["event"] == "frames_left_out"] == [2]
    assert len(fit.gains) == 22


def test_a_fit_that_is_stopped_gives_the_grid_so_far() -> None:
    done: list[int] = []
    fit = fit_grid(objects(), SMALL, lambda p: done.append(p.step), lambda: len(done) >= 7)
    assert fit.steps == 7


def test_a_box_for_too_many_voxels_grows_them_and_says_so() -> None:
    config = GridFitConfig(long_side=600, box_m=(0, 0, 0, 5, 5, 5))
    with structlog.testing.capture_logs() as logs:
        box = scene_box(objects(), config)
    assert np.prod(box.shape) <= 1 << 24
    assert [entry["wanted_m"] for entry in logs if entry["event"] == "voxels_grown"] == [0.0083]
    with pytest.raises(ConfigError, match=r"set voxel_m to 0\.0197 or more"):
        scene_box(objects(), msgspec.structs.replace(config, voxel_m=0.01))


def test_without_depth_the_box_holds_what_matched_features_show() -> None:
    box = scene_box(objects(), GridFitConfig())
    high = [o + (n - 1) * box.voxel_m for o, n in zip(box.origin_m, box.shape, strict=True)]
    assert all(-8 < o < low for o, low in zip(box.origin_m, BOX_M[:3], strict=True))
    assert all(top < h < 8 for h, top in zip(high, BOX_M[3:], strict=True))
    assert 2e6 < np.prod(box.shape) < 3e6


def test_without_depth_and_features_the_box_is_what_cameras_can_see_and_that_is_said() -> None:
    plain = [replace(frame, rgb=np.full_like(frame.rgb, 128)) for frame in objects()]
    with structlog.testing.capture_logs() as logs:
        box = scene_box(plain, GridFitConfig(far_m=12.0))
    high = [o + (n - 1) * box.voxel_m for o, n in zip(box.origin_m, box.shape, strict=True)]
    assert all(o < -4 and h > 3 for o, h in zip(box.origin_m, high, strict=True))
    assert [entry["far_m"] for entry in logs if entry["event"] == "box_guessed"] == [12.0]


def test_triangulated_points_lie_on_the_surface() -> None:
    frames = tiny_frames()
    points = sparse_points(frames)
    assert len(points) > 30
    off = []
    for frame in frames:
        in_camera = transform(invert_pose(frame.T_world_camera), points)
        seen, v, u = nearest_pixels(in_camera, frame.intrinsics)
        assert frame.depth_m is not None
        depth = frame.depth_m[v[seen], u[seen]]
        off.append(np.abs(in_camera[seen, 2] - depth)[depth > 0] / depth[depth > 0])
    assert np.median(np.concatenate(off)) < 0.1
    assert len(sparse_points([replace(f, T_world_camera=frames[0].T_world_camera) for f in frames])) == 0
