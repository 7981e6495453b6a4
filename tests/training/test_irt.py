"""Fitting an Implicit Ray-Transformer: what stays, what is learned, what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.fields.checkpoint import load_checkpoint, save_checkpoint
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.labels import make_label_set
from semantic_mapper.rays import pixel_grid
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig, IRTFitConfig
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.irt import ClassFit, fit_irt, labelled_rays
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import CameraIntrinsics, PosedFrame

CAMERA = CameraIntrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
HEIGHTS = make_label_set("heights", ["ground", "deck"])
SMALL = FinetuneConfig(
    seconds=0,
    steps=150,
    width=64,
    device="cpu",
    grid=GridFitConfig(long_side=40, rays=512, held_out=0, exposure=False),
    irt=IRTFitConfig(variant="B", carry_labels=False),
)


def look_down(azimuth: float) -> np.ndarray:
    """T_world_camera on a ring 3 m above the ground, looking at the middle."""
    position = np.array([1.6 * np.cos(azimuth), 1.6 * np.sin(azimuth), 3.0])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(forward, right), forward), 1)
    T[:3, 3] = position
    return T


def two_planes(azimuth: float, number: int, *, label: bool, shift: float = 0.0) -> PosedFrame:
    """A deck 0.8 m above the ground, both of one texture: only their height tells them apart.

    The deck stands ``shift`` m further along x.
    """
    T = look_down(azimuth)
    pixels = pixel_grid(64, 48).numpy().astype(np.float64)
    d = np.stack(((pixels[:, 0] - CAMERA.cx) / CAMERA.fx, (pixels[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(64 * 48)), 1)
    d = d @ T[:3, :3].T
    up, down = (0.8 - T[2, 3]) / d[:, 2], -T[2, 3] / d[:, 2]
    at = T[:3, 3] + up[:, None] * d
    # On another side of the picture from elsewhere.
    deck = (np.abs(at[:, 0] - 0.8 - shift) < 0.7) & (np.abs(at[:, 1]) < 0.7)
    z = np.where(deck, up, down)
    seen = T[:3, 3] + z[:, None] * d - deck[:, None] * (shift, 0, 0)
    cell = np.floor(seen[:, :2] / 0.15).astype(np.int64)
    grey = (cell[:, 0] * 7919 + cell[:, 1] * 104729) % 97 / 97
    rgb = np.stack((grey, 0.5 + 0.5 * grey, 1 - grey), 1) * 255
    return PosedFrame(
        stamp_ns=number,
        seq=number,
        camera_id="cam",
        rgb=rgb.reshape(48, 64, 3).astype(np.uint8),
        depth_m=z.reshape(48, 64).astype(np.float32),
        label=np.where(deck, HEIGHTS.ids[1], HEIGHTS.ids[0]).reshape(48, 64).astype(np.uint8) if label else None,
        intrinsics=CAMERA,
        T_world_camera=T,
    )


@cache
def scene() -> tuple[PosedFrame, ...]:
    """One labelled frame, eleven others."""
    return tuple(two_planes(i * 2 * np.pi / 12, i, label=i == 0) for i in range(12))


def accuracy(field: IRT, query: PosedFrame) -> float:
    view = view_from_frame(query, HEIGHTS, 64)
    encoded = field.encode(stack_sources([view]))
    none = np.zeros((48, 64), np.float32)
    render = render_image(field, encoded, CAMERA, query.T_world_camera, none, field.sampling, 0)
    found = render.logits.argmax(1)
    return float(((found == view.channel.flatten()) & render.known).float().mean())


def test_two_planes_of_one_texture_are_told_apart_by_height_which_a_picture_cannot() -> None:
    query = two_planes(np.pi + 0.2, 99, label=True)
    assert query.label is not None
    checkpoint = fit_irt(scene(), HEIGHTS, None, SMALL)
    assert isinstance(checkpoint.model, IRT)
    by_height = accuracy(checkpoint.model, query)
    unet = UNetBaseline(HEIGHTS, UNetConfig(steps=40, width=64))
    unet.fit([scene()[0]])
    by_picture = float((unet.predict(query) == query.label).mean())
    assert by_height > 0.93
    assert by_height > by_picture + 0.1


def small_field(labelled: int, **changes: object) -> tuple[IRT, ClassFit]:
    frames = [two_planes(i * 1.0, i, label=True) for i in range(labelled)]
    config = msgspec.structs.replace(SMALL, steps=12, irt=IRTFitConfig(variant="RTTC"), **changes)
    checkpoint = fit_irt([*frames, *scene()[1:4]], HEIGHTS, None, msgspec.structs.replace(config, steps=1))
    field = checkpoint.model
    assert isinstance(field, IRT)
    return field, ClassFit(field, labelled_rays(frames, HEIGHTS, config), config)


def test_geometry_colours_and_features_stay_as_they_are_while_classes_are_learned() -> None:
    field, fit = small_field(2)
    before = {n: t.clone() for n, t in field.state_dict().items()}
    fit.run(0.0)
    moved = {n for n, t in field.state_dict().items() if not torch.equal(t, before[n])}
    assert moved and not any(n.startswith(("grid.", "trunk.", "fitted")) for n in moved)
    assert {"classifier.weight", "image_head.weight", "vote.weight", "points.enter.weight"} <= moved


def test_a_ray_never_sees_the_labels_of_its_own_frame_while_it_learns() -> None:
    field, fit = small_field(1)
    assert field.carried is not None
    pixels = fit.pool.draw(64, torch.Generator().manual_seed(0))[0]
    everything = torch.ones(1, dtype=torch.bool)
    votes = fit._carried(pixels, fit._samples(pixels, with_depth=True), everything)
    assert votes is not None and float(votes.abs().max()) == 0
    seen = field.carried_to(fit._samples(pixels, with_depth=True))
    assert seen is not None and float(seen[:, -1].median()) > 0.3  # a query does


def test_held_out_blocks_choose_the_weights_and_nothing_learns_from_them() -> None:
    _, fit = small_field(2)
    drawn = torch.cat([fit.pool.draw(2048, torch.Generator().manual_seed(i))[0] for i in range(5)])
    assert int(fit.data.held_out.sum()) > 0 and not bool(fit.data.held_out[drawn].any())
    told: list[FitProgress] = []
    best, _ = fit.run(0.0, told.append)
    looks = [p for p in told if p.best]
    assert best.step == looks[-1].step and best.loss == min(p.held_out_loss for p in told)
    assert told[-1].fraction == 1.0


def test_a_fit_repeats_bit_for_bit_and_comes_back_from_its_file(tmp_path) -> None:
    config = msgspec.structs.replace(SMALL, steps=5, irt=IRTFitConfig())
    frames = [two_planes(0.0, 0, label=True), two_planes(0.5, 1, label=True), *scene()[2:5]]
    first, second = (fit_irt(frames, HEIGHTS, None, config, seen_stamps_ns=(77,)) for _ in range(2))
    states = [c.model.state_dict() for c in (first, second)]
    assert all(torch.equal(t, states[1][n]) for n, t in states[0].items())
    assert first.train_stamps_ns == {0, 1, 77} and first.recipe["steps"] == 5 and first.recipe["grid_steps"] == 5
    save_checkpoint(first, tmp_path / "w.safetensors")
    field = load_checkpoint(tmp_path / "w.safetensors").model
    assert isinstance(field, IRT) and field.carried is not None
    assert torch.equal(field.carried.T_camera_world, states[0]["carried.T_camera_world"])  # poses are not rounded
    assert torch.equal(field.carried.channel, states[0]["carried.channel"])
    again = msgspec.structs.replace(config, irt=IRTFitConfig(variant="B"))
    other = fit_irt(frames, HEIGHTS, field, again).model
    assert isinstance(other, IRT) and other.shape.variant == "B" and other.shape.grid == field.shape.grid


def test_a_stopped_fit_gives_the_best_so_far() -> None:
    told: list[FitProgress] = []
    config = msgspec.structs.replace(SMALL, steps=60)
    checkpoint = fit_irt(scene(), HEIGHTS, None, config, told.append, lambda: len(told) >= 130)
    assert [round(told[i].fraction, 2) for i in (59, 119)] == [0.35, 0.5]  # geometry, then features
    assert 0 < checkpoint.recipe["steps"] < 60 and 0 <= checkpoint.recipe["held_out_accuracy"] <= 1


def test_what_cannot_teach_is_refused() -> None:
    unlabelled = [replace(f, label=None) for f in scene()]
    with pytest.raises(FrameError, match="no frame has a label"):
        fit_irt(unlabelled, HEIGHTS, None, SMALL)
    plain = replace(scene()[0], label=np.full((48, 64), HEIGHTS.ids[0], np.uint8))
    with pytest.raises(FrameError, match="fewer than two classes"):
        fit_irt([plain, *unlabelled[1:]], HEIGHTS, None, SMALL)
    turned = [replace(f, T_world_camera=scene()[0].T_world_camera) for f in scene()]
    with pytest.raises(FrameError, match="only turn"):
        fit_irt(turned, HEIGHTS, None, SMALL)
    other = IRT(msgspec.structs.replace(fit_config(), carried=0), make_label_set("other", ["a", "b"]))
    with pytest.raises(WeightsError, match="label set 'other'"):
        fit_irt(scene(), HEIGHTS, other, SMALL)


def fit_config():
    from tests.fields.tiny_fields import TINY_IRT

    return TINY_IRT
