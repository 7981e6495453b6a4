"""Scenes that NeSF is trained on: the samples of their rays, and which rays are drawn."""

from __future__ import annotations

import numpy as np
import torch

from research.peers.grid_nesf import GridNesf, GridNesfConfig
from research.scenes.klevr import BOX_LOW_M
from research.suites.klevr import KlevrConfig, label_map_numbers, scene_frames
from research.train.grid_nesf import (
    GridNesfTraining,
    LabelledScene,
    favour_by_frequency,
    labelled_scene,
    marched,
)
from semantic_mapper.config import GridConfig
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.labels import KLEVR
from semantic_mapper.training.views import frame_rays

RUN = KlevrConfig(width=40, views=12, train_views=8, label_maps=2)
TRAINING = GridNesfTraining(network=GridNesfConfig(size=16, width=4), near_m=1.0)


def some_scene() -> tuple[SceneGrid, LabelledScene]:
    """A half transparent slab under true labels."""
    grid = SceneGrid(GridConfig(origin_m=BOX_LOW_M, voxel_m=0.4, shape=(21, 21, 8)))
    grid.values[..., 0] = -10.0
    grid.values[3:18, 3:18, 1:4, 0] = 4.0
    grid.update_occupied()
    frames = scene_frames(RUN, 0, label_map_numbers(RUN, 0))
    return grid, labelled_scene(grid, frames, KLEVR, TRAINING)


def test_kept_samples_are_those_of_rays_marched_anew() -> None:
    grid, scene = some_scene()
    pixels = np.random.default_rng(0).integers(len(scene.channel), size=300)
    pixels[1] = pixels[0]  # a pixel that is drawn twice is two rays
    found = scene.on_rays(pixels)
    rays = frame_rays(scene_frames(RUN, 0, label_map_numbers(RUN, 0)), RUN.width)
    anew = marched(grid, rays, pixels, TRAINING.near_m)
    assert len(found.ray) > 300 and torch.equal(found.ray, anew.ray)
    torch.testing.assert_close(found.xyz, anew.xyz)
    torch.testing.assert_close(found.weight, anew.weight)


def test_balanced_rays_are_spread_over_the_classes_of_the_scene() -> None:
    _, scene = some_scene()
    rng, present = np.random.default_rng(0), len(scene.by_class)
    of_all = np.bincount(scene.channel.numpy(), minlength=len(KLEVR)) / len(scene.channel)
    assert present > 2 and of_all[0] > 0.8
    drawn = np.bincount(scene.channel[scene.draw(8000, 0.5, rng)].numpy(), minlength=len(KLEVR)) / 8000
    expected = 0.5 * of_all + 0.5 * (of_all > 0) / present
    assert np.abs(drawn - expected).max() < 0.03
    assert np.allclose(scene.frequencies(len(KLEVR), 0.5), expected)
    any_pixel = np.bincount(scene.channel[scene.draw(8000, 0.0, rng)].numpy(), minlength=len(KLEVR)) / 8000
    assert np.abs(any_pixel - of_all).max() < 0.03


def test_classes_that_are_drawn_more_often_than_seen_lose_what_that_gave_them() -> None:
    _, scene = some_scene()
    model = GridNesf(KLEVR, TRAINING.network)
    before = model.head.bias.detach().clone()
    weight, ray = torch.tensor((0.25, 0.25, 1.0)), torch.tensor((0, 0, 1))
    logits = torch.randn(3, len(KLEVR))
    with torch.no_grad():
        rendered = model.composite(logits, weight, ray, 3)
        favour_by_frequency(model, [scene, scene], 0.5)
        shift = model.head.bias - before
        after = model.composite(logits + shift, weight, ray, 3)
    true, drawn = scene.frequencies(len(KLEVR), 0.0), scene.frequencies(len(KLEVR), 0.5)
    gained, seen = shift.numpy(), true > 0
    assert gained[0] > 0 > gained[seen][1:].max() and (gained[~seen] == 0).all()
    assert np.allclose(np.exp(gained[seen]) * drawn[seen], true[seen], rtol=1e-4)
    torch.testing.assert_close(after, rendered + shift)  # however much of a ray's light is left
