"""Boxes that move: what is in them has its class where they are at the time, and leaves nothing where they were."""

import itertools
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.config import PanopticConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.scene.panoptic import Panoptic, box_config
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.fields.views import encoded_views
from semantic_mapper.labels import make_label_set
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.views import frame_rays, stack_sources, view_from_frame
from semantic_mapper.types import FieldRender, PosedFrame
from tests.training.test_panoptic import SMALL
from tests.training.two_planes import BOX_M, two_planes

SET = make_label_set("deck", ["floor", "table"])
FLOOR, TABLE = 0, 1
FRAMES, GAP_NS = 10, 100
SHIFTS = np.linspace(-1.6, 0.0, FRAMES)  # of the deck, whose middle is at x = 0.8 m without


def deck_pose(number: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = (0.8 + SHIFTS[number], 0.0, 0.75)
    return T


@cache
def deck() -> Primitive:
    stamps = tuple((n * GAP_NS, deck_pose(n)) for n in range(FRAMES))
    return Primitive(7, "table", "box", deck_pose(0), np.array((1.7, 1.7, 0.4)), thing=True, stamps=stamps)


def view(azimuth: float, number: int) -> PosedFrame:
    frame = two_planes(azimuth, number, label=True, shift=float(SHIFTS[number]))
    assert frame.label is not None
    label = np.where(frame.label == 2, SET.ids[TABLE], SET.ids[FLOOR]).astype(np.uint8)
    return replace(frame, label=label, label_is_pseudo=True, stamp_ns=number * GAP_NS)


@cache
def scene() -> tuple[PosedFrame, ...]:
    azimuths = itertools.cycle(np.linspace(0, 2 * np.pi, 7, endpoint=False))
    return tuple(view(next(azimuths), n) for n in range(FRAMES))


def start(*boxes: Primitive) -> Panoptic:
    return Panoptic(PanopticConfig(boxes=tuple(box_config(b) for b in boxes)), SET)


@cache
def fitted() -> Checkpoint:
    return finetune(scene(), SET, start(deck()), SMALL)


def seen(
    field: Panoptic, frame: PosedFrame, stamp_ns: int | None, depth_m: torch.Tensor | None = None
) -> tuple[FieldRender, torch.Tensor]:
    """A frame's camera at some time, its depth measured or not: what is rendered, and which things."""
    rays = frame_rays([frame], 64)
    batch = replace(rays.rays(rays.pixels_of(0), 0.1), stamp_ns=stamp_ns)
    if depth_m is not None:
        batch = replace(batch, prior_depth_m=depth_m)
    views = stack_sources([view_from_frame(replace(frame, label=None), SET, 64)])
    with torch.no_grad():
        render = field.render(batch, encoded_views(views, views.rgb[:, :0]))
        return render, field.instances(batch, render.logits.argmax(1))


def model(checkpoint: Checkpoint) -> Panoptic:
    assert isinstance(checkpoint.model, Panoptic)
    return checkpoint.model


@pytest.mark.parametrize("number", [1, 8])
def test_a_box_has_its_class_where_it_is_at_the_time(number: int) -> None:
    frame = view(0.4, number)
    assert frame.label is not None and frame.depth_m is not None
    render, things = seen(model(fitted()), frame, frame.stamp_ns)
    truth = torch.from_numpy(np.where(frame.label.ravel() == SET.ids[TABLE], TABLE, FLOOR))
    said = render.logits.argmax(1)
    assert (said == truth)[render.known].float().mean() > 0.95 and render.known.float().mean() > 0.9
    assert (things[said == TABLE] == 7).all() and (things[said == FLOOR] == 0).all()
    on_it = (said == TABLE) & (truth == TABLE)
    error = (render.depth_m - torch.from_numpy(frame.depth_m.ravel())).abs()
    assert error[on_it].median() < 0.06
    colour = torch.from_numpy(frame.rgb.reshape(-1, 3) / 255.0)
    assert (render.rgb - colour)[on_it].mean(0).abs().max() < 0.1


def test_it_leaves_nothing_in_the_scene_that_stands_still() -> None:
    frame = view(0.4, 4)
    render, things = seen(model(fitted()), frame, None)
    ground = two_planes(0.4, 4, label=True, shift=50.0).depth_m
    assert ground is not None
    wrong = (render.depth_m - torch.from_numpy(ground.ravel())).abs() > 0.2
    assert (wrong & render.known).float().mean() < 0.01
    assert (things == 0).all()
    still = model(finetune(scene(), SET, start(replace(deck(), stamps=None)), SMALL))
    smeared, _ = seen(still, frame, None)
    wrong = (smeared.depth_m - torch.from_numpy(ground.ravel())).abs() > 0.2
    assert (wrong & smeared.known).float().mean() > 0.05, "as if it stood still"


def test_between_stamps_a_box_is_on_the_way() -> None:
    np.testing.assert_allclose(deck().pose_at(GAP_NS // 2), (deck_pose(0) + deck_pose(1)) / 2)
    unsorted = replace(deck(), stamps=tuple(reversed(deck().stamps or ())))
    np.testing.assert_array_equal(unsorted.pose_at(3 * GAP_NS), deck_pose(3))


def test_without_depth_the_core_of_a_box_is_full() -> None:
    config = msgspec.structs.replace(SMALL, steps=10, grid=msgspec.structs.replace(SMALL.grid, box_m=BOX_M))
    field = model(finetune([replace(f, depth_m=None) for f in scene()], SET, start(deck()), config))
    frame = view(0.4, 3)
    _, things = seen(field, frame, frame.stamp_ns)
    assert frame.label is not None
    found, true = (things == 7).numpy(), frame.label.ravel() == SET.ids[TABLE]
    assert (found & true).sum() > 0.7 * (found | true).sum()


def test_a_box_that_no_frame_shows_at_its_times_is_left_out() -> None:
    config = msgspec.structs.replace(SMALL, steps=2)
    away = replace(deck(), id=8, stamps=((900_000_000, deck_pose(0)),))
    checkpoint = finetune(scene(), SET, start(deck(), away), config)
    assert [b.id for b in model(checkpoint).shape.boxes] == [7]
    assert (checkpoint.recipe["panoptic"]["moving"], checkpoint.recipe["panoptic"]["lost"]) == (1, 1)
    with pytest.raises(ConfigError, match="stamps of those that move"):
        finetune(scene(), SET, start(away), config)
