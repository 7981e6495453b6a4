"""Fitting grids: to images, from depth, and what is refused."""

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import structlog
import torch

from semantic_mapper.config import GridConfig
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.learned import build_field
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import Budget
from semantic_mapper.training.grid_fit import fit_grid, held_out_psnr, render_frame
from semantic_mapper.training.scene_box import scene_box
from semantic_mapper.training.views import frame_rays
from semantic_mapper.types import PosedFrame
from tests.small import tiny_frames
from tests.training.two_planes import BOX_M, two_planes

GRID = GridFitConfig(rays=512, long_side=40, box_m=BOX_M, exposure=False, held_out=6)
SMALL = FinetuneConfig(seconds=0, steps=150, width=64, grid=GRID)


@cache
def planes(count: int = 24) -> tuple[PosedFrame, ...]:
    """Views from round a deck, without depth."""
    azimuths = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return tuple(replace(two_planes(a, n, label=False), depth_m=None) for n, a in enumerate(azimuths))


def test_a_fit_renders_views_that_it_has_not_seen_far_better_than_their_mean_colour() -> None:
    losses: list[float] = []
    fit = fit_grid(planes(), SMALL, Budget(0, 150, on_progress=lambda p: losses.append(p.loss)))
    assert fit.steps == len(losses) == 150 and max(fit.grid.config.shape) == 40
    held_out = planes()[5::6]
    psnr, mean_colour = held_out_psnr(fit.grid, held_out, SMALL)
    assert fit.psnr == pytest.approx(psnr) and psnr > mean_colour + 2


def test_the_same_fit_gives_the_same_bits_on_any_number_of_threads() -> None:
    config = msgspec.structs.replace(SMALL, steps=40, grid=msgspec.structs.replace(GRID, held_out=0))
    before = torch.get_num_threads()
    grids: list[dict[str, torch.Tensor]] = []
    try:
        for threads in (1, 1, 3):
            torch.set_num_threads(threads)
            grids.append(fit_grid(planes(), config).grid.state_dict())
    finally:
        torch.set_num_threads(before)
    for other in grids[1:]:
        assert all(torch.equal(tensor, other[name]) for name, tensor in grids[0].items())


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


def test_a_trunk_learns_colours_in_the_grids_geometry() -> None:
    progress = []
    start = build_field("grid", {"features": 4, "trunk_width": 16}, ROOMS)
    checkpoint = finetune(planes(), ROOMS, start, SMALL, progress.append, seen_stamps_ns=(7,))
    field = checkpoint.model
    assert isinstance(field, GridField) and field.trunk is not None and field.fitted and not field.training
    assert checkpoint.recipe["steps"] == 150 and checkpoint.recipe["train_stamps_ns"] == [7]
    assert checkpoint.recipe["psnr"] > 0 and checkpoint.width == 64
    fractions = [p.fraction for p in progress]
    assert len(fractions) == 150 + 150 and fractions == sorted(fractions) and fractions[-1] == 1
    rays = frame_rays(planes(), 64)
    pixels = rays.pixels_of(5)
    with torch.no_grad():
        samples = field.march(rays.rays(pixels, GRID.near_m))
        colour = (samples.weight[..., None] * field.colour(samples)).sum(1)
    solid = samples.opacity > 0.9
    error = (colour - rays.colours(pixels))[solid].square().mean()
    assert solid.sum() > 500 and error < 0.85 * rays.colours(pixels).var(0).mean()


def test_poses_that_only_turn_or_do_not_fit_the_images_are_refused() -> None:
    still = [replace(f, T_world_camera=np.c_[f.T_world_camera[:, :3], (1, 2, 3, 1)]) for f in planes()]
    with pytest.raises(FrameError, match=r"only turn tell no depth.*T_world_camera, with translations in metres"):
        fit_grid(still, SMALL)
    axes = np.diag([1.0, -1.0, -1.0, 1.0])  # those of OpenGL (y up, z backward): every view looks away from the scene
    wrong = [replace(f, T_world_camera=f.T_world_camera @ axes) for f in planes()]
    with pytest.raises(FrameError, match=r"hardly better than by their mean colour.*z forward"):
        fit_grid(wrong, SMALL)


def test_frames_with_impossible_poses_are_left_out_and_counted() -> None:
    broken = [replace(f, T_world_camera=np.full((4, 4), np.nan)) for f in planes()[:2]]
    with structlog.testing.capture_logs() as logs, pytest.raises(FrameError, match=r"at least 2 frames.*got 1"):
        finetune([*broken, *planes()[2:3]], ROOMS, None, SMALL, kind="grid")
    assert [entry["count"] for entry in logs if entry["event"] == "frames_left_out"] == [2]


def test_a_box_for_too_many_voxels_grows_them_and_says_so() -> None:
    config = GridFitConfig(long_side=600, box_m=(0, 0, 0, 5, 5, 5))
    with structlog.testing.capture_logs() as logs:
        box = scene_box(planes(), config)
    assert np.prod(box.shape) <= 1 << 24
    assert [entry["wanted_m"] for entry in logs if entry["event"] == "voxels_grown"] == [0.0083]
    with pytest.raises(ConfigError, match=r"set voxel_m to 0\.0197 or more"):
        scene_box(planes(), msgspec.structs.replace(config, voxel_m=0.01))


def corners(box: GridConfig) -> np.ndarray:
    low = np.array(box.origin_m)
    return np.stack((low, low + (np.array(box.shape) - 1) * box.voxel_m))


def test_without_depth_the_box_holds_what_matched_features_show() -> None:
    box = scene_box([replace(f, depth_m=None) for f in tiny_frames()], GridFitConfig())
    measured = corners(scene_box(tiny_frames(), GridFitConfig()))
    sides = np.diff(measured, axis=0)[0]
    assert (np.abs(corners(box) - measured) < 0.5 * sides).all()
    assert 2e6 < np.prod(box.shape) < 3e6
