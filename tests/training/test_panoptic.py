"""Panoptic NeRF: what boxes and pseudo labels teach, what they do not, and what is refused."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.config import BoxConfig, GridConfig, PanopticConfig
from semantic_mapper.errors import ConfigError, FrameError, LabelError, WeightsError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.scene.panoptic import BoxesOnRays, Panoptic, box_config, merged_classes, primitive_of
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.fields.views import encoded_views
from semantic_mapper.labels import make_label_set
from semantic_mapper.training.config import FinetuneConfig, GridFitConfig, PanopticFitConfig, StepConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.panoptic import boxes_in_view, semantic_losses
from semantic_mapper.training.views import frame_rays, stack_sources, view_from_frame
from semantic_mapper.types import PosedFrame, RayBatch
from tests.training.two_planes import two_planes

SET = make_label_set("deck", ["floor", "table", "lamp", "sky"])
FLOOR, TABLE, LAMP, SKY = 0, 1, 2, 3
SMALL = FinetuneConfig(
    seconds=0,
    steps=40,
    width=64,
    device="cpu",
    grid=GridFitConfig(long_side=40, rays=256, held_out=0, exposure=False),
    step=StepConfig(rays=128),
)


def box(number: int, name: str, centre: tuple[float, float, float], size: tuple[float, float, float]) -> BoxConfig:
    T = np.eye(4)
    T[:3, 3] = centre
    return box_config(Primitive(number, name, "box", T, np.array(size), thing=name != "floor"))


# The deck is flat at 0.8 m; the box is coarse, as people draw them.
DECK = box(7, "table", (0.8, 0.0, 0.75), (1.7, 1.7, 0.5))


@cache
def scene(labelled: bool = True) -> tuple[PosedFrame, ...]:
    """Views of a deck above the ground, with pseudo labels: half of the left side of each is called a lamp."""
    frames: list[PosedFrame] = []
    for n, azimuth in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        frame = two_planes(azimuth, n, label=True)
        assert frame.label is not None
        label = np.where(frame.label == 2, SET.ids[TABLE], SET.ids[FLOOR]).astype(np.uint8)
        label[::2, :20] = SET.ids[LAMP]
        frames.append(replace(frame, label=label if labelled else None, label_is_pseudo=labelled))
    return tuple(frames)


def empty_field(*boxes: BoxConfig, **changes: object) -> Panoptic:
    grid = GridConfig(origin_m=(-2.0, -2.0, -0.5), voxel_m=0.1, shape=(41, 41, 31))
    return Panoptic(msgspec.structs.replace(PanopticConfig(grid=grid, boxes=boxes), **changes), SET)


@cache
def fitted() -> Checkpoint:
    return finetune(scene(), SET, empty_field(DECK), SMALL)


def answers(field: Panoptic, frame: PosedFrame) -> tuple[torch.Tensor, RayBatch]:
    """Channels of all pixels of a frame, and their rays."""
    rays = frame_rays([frame], 64)
    batch = rays.rays(rays.pixels_of(0), 0.1)
    views = stack_sources([view_from_frame(replace(frame, label=None), SET, 64)])
    with torch.no_grad():
        render = field.render(batch, encoded_views(views, views.rgb[:, :0]))
    return torch.where(render.known, render.logits.argmax(1), -1), batch


def test_boxes_outvote_wrong_labels_and_tell_which_thing_it_is() -> None:
    field = fitted().model
    assert isinstance(field, Panoptic)
    frame = two_planes(0.4, 20, label=True)
    assert frame.label is not None
    truth = torch.from_numpy(np.where(frame.label.ravel() == 2, TABLE, FLOOR))
    said, rays = answers(field, frame)
    seen = said != SKY  # its corners look where no frame has looked
    assert seen.float().mean() > 0.9
    assert (said == truth)[seen].float().mean() > 0.96
    assert (said == LAMP).float().mean() < 0.01  # a fifth of the pseudo labels
    things = field.instances(rays, said)
    assert set(things.unique().tolist()) == {0, 7}
    assert (things[said == FLOOR] == 0).all()
    assert (things[said == TABLE] == 7).float().mean() > 0.95
    figures = fitted().recipe["panoptic"]
    assert (figures["boxes"], figures["seen"], figures["labelled_frames"]) == (1, 1, 8)
    assert 0.05 < figures["covered"] < 0.95 and 0.95 < figures["matched"] <= 1  # lamps may be outside
    assert fitted().train_stamps_ns == frozenset()  # pseudo labels are no truth


def test_what_leaves_the_grid_sees_the_first_box_behind_it_else_the_sky() -> None:
    far, farther = box(1, "floor", (9.0, 0.0, 0.5), (2.0, 1.0, 1.0)), box(2, "lamp", (20.0, 0.0, 0.5), (2.0, 9.0, 1.0))
    field = empty_field(farther, far, box(3, "table", (1.0, 0.0, 0.5), (0.2, 1.0, 1.0)))
    n = 3
    origin = torch.tensor([(-1.0, 0.0, 0.5), (-1.0, 3.0, 0.5), (-1.0, 0.0, 0.5)])
    direction = torch.tensor([(1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    rays = RayBatch(origin, direction, torch.full((n,), 0.1), torch.full((n,), torch.inf), torch.zeros(n))
    with torch.no_grad():
        field.grid.values[..., 0] = -20.0  # nothing stops light
        samples = field.march(rays)
        boxes = field.boxes_on(samples)
        said = field.composited(samples, boxes.fixed, boxes).argmax(1)
    assert samples.light.min() > 0.99
    assert said.tolist() == [FLOOR, LAMP, SKY], "the table is in the grid, which is empty there"


def gradients(
    field: Panoptic, origin: tuple[float, float, float], channel: int, learned: float = 1.0
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Gradient of the density, and of the classifier, by one pseudo label on a ray straight down."""
    with torch.no_grad():
        field.grid.values[..., 0] = 5.0
    field.grid.values.requires_grad_(True)
    field.fitted_steps.fill_(1)
    one, none = torch.ones(1), torch.zeros(1)
    rays = RayBatch(torch.tensor([origin]), torch.tensor([(0.0, 0.0, -1.0)]), 0.1 * one, torch.inf * one, none)
    samples = field.march(rays, kept=64)
    boxes = field.boxes_on(samples)
    weights = PanopticFitConfig(points=0.0, learned=learned)
    group = merged_classes(SET, field.shape.merge)
    loss = semantic_losses(field, samples, boxes, field.learned(samples), torch.tensor([channel]), group, weights)
    loss.backward()
    assert field.grid.values.grad is not None
    return field.grid.values.grad, field.classifier.weight.grad


@pytest.mark.parametrize("uncovered", ["stuff", "empty"])
def test_a_pseudo_label_off_every_primitive_has_no_gradient(uncovered: str) -> None:
    away, through = (-1.0, 0.0, 2.0), (0.8, 0.0, 2.0)
    for origin, moves in ((away, False), (through, True)):
        for gradient in gradients(empty_field(DECK, uncovered=uncovered), origin, TABLE):
            assert gradient is not None and bool((gradient != 0).any()) == moves
    # Of a class without any box: it may be outside, where anything may be.
    for gradient in gradients(empty_field(DECK, uncovered=uncovered), away, LAMP):
        assert gradient is not None and bool((gradient != 0).any()) == (uncovered == "stuff")


def test_merged_classes_share_a_pseudo_label() -> None:
    for merge in ({"lamp": ("table",)}, {}):
        density, _ = gradients(empty_field(DECK, merge=merge, uncovered="empty"), (0.8, 0.0, 2.0), LAMP)
        assert bool(density.any()) == bool(merge)


def along_a_ray(field: Panoptic, *z: float) -> BoxesOnRays:
    """What boxes hold points on a ray straight down from 2 m, through the middle of the deck."""
    field.fitted_steps.fill_(1)
    one, none = torch.ones(1), torch.zeros(1)
    rays = RayBatch(torch.tensor([(0.8, 0.0, 2.0)]), torch.tensor([(0.0, 0.0, -1.0)]), 0.1 * one, 9 * one, none)
    samples = field.march(rays)
    depths = torch.tensor([z])
    points = rays.origin[:, None] + depths[..., None] * rays.direction[:, None]
    return field.boxes_on(replace(samples, z=depths, points=points, weight=torch.ones_like(depths) / len(z)))


def test_near_the_faces_of_a_box_its_class_and_what_needs_no_box_are_possible() -> None:
    heights = (0.95, 0.98, 1.02, 1.05, 1.48)  # above the box, near its top (twice), inside, near its bottom
    table, rest, either = [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0]
    found = along_a_ray(empty_field(DECK), *heights)
    assert found.classes[0].tolist() == [rest, either, either, table, either]
    assert found.fixed[0, 1].tolist() == [0.25, 0.5, 0.25, 0.0]
    said = found.allowed_of(torch.full((1, 5, 4), 0.25))
    assert said[0, 3].tolist() == table and said[0, 0].tolist() == [0.5, 0.0, 0.5, 0.0]
    exact = along_a_ray(empty_field(DECK, uncovered="empty"), *heights)
    assert exact.classes[0].tolist() == [[0.0] * 4, [0.0] * 4, table, table, table]


def test_of_overlapping_boxes_of_a_class_the_nearer_centre_has_the_point() -> None:
    left, right = box(3, "table", (-0.4, 0, 0.5), (1, 1, 1)), box(4, "table", (0.4, 0, 0.5), (1, 1, 1))
    field = empty_field(left, right)
    with torch.no_grad():
        field.grid.values[:, :, 10:, 0] = -10.0  # all is below z = 0.5
        field.grid.values[:, :, :10, 0] = 9.0
    field.grid.update_occupied()
    field.fitted_steps.fill_(1)
    x = torch.tensor([-0.7, -0.05, 0.05, 0.7, 1.5])
    origin = torch.stack((x, 0 * x, 0 * x + 2), 1)
    down = torch.tensor((0.0, 0.0, -1.0)).expand(5, 3)
    rays = RayBatch(origin, down, 0 * x + 0.1, 0 * x + 9, 0 * x)
    assert field.instances(rays, torch.full((5,), TABLE)).tolist() == [3, 3, 4, 4, 0]
    assert field.instances(rays, torch.full((5,), FLOOR)).tolist() == [0] * 5


def test_boxes_that_no_frame_can_see_are_left_out_wherever_they_move() -> None:
    behind = box(1, "lamp", (0.0, 0.0, 9.0), (1, 1, 1))  # above cameras that look down
    beside = box(2, "lamp", (0.0, 60.0, 0.0), (1, 1, 1))
    around = box(3, "floor", (0.0, 0.0, 3.0), (12, 12, 1))  # cameras are in it
    seen = boxes_in_view([primitive_of(b) for b in (DECK, behind, beside, around)], scene())
    assert seen.tolist() == [True, False, False, True]
    stamps = sorted(f.stamp_ns for f in scene())
    here, there = (primitive_of(b).T_world_box for b in (DECK, beside))
    moving = replace(primitive_of(DECK), stamps=((stamps[0], there), (stamps[1], here)))
    later = replace(moving, stamps=((stamps[-1] + 10**9, here),))
    away = replace(moving, stamps=tuple((t, there) for t in stamps))
    assert boxes_in_view([moving, later, away], scene()).tolist() == [True, False, False]
    with pytest.raises(ConfigError, match=r"boxes lie from \(0.00, 60.00, .*cameras from .*world frame"):
        boxes_in_view([primitive_of(beside)], scene())


@pytest.mark.parametrize("joint", [0, 2])
def test_a_stop_before_classes_are_learned_leaves_what_the_boxes_say(joint: int, tmp_path: Path) -> None:
    done: list[FitProgress] = []
    stopped = finetune(scene(), SET, empty_field(DECK), SMALL, done.append, lambda: len(done) >= SMALL.steps + joint)
    assert (stopped.recipe["grid_steps"], stopped.recipe["steps"]) == (SMALL.steps, joint)
    save_checkpoint(stopped, tmp_path / "w.safetensors")
    field = load_checkpoint(tmp_path / "w.safetensors").model
    assert isinstance(field, Panoptic) and field.shape.classes == "fixed"
    said, _ = answers(field, scene()[0])
    truth = two_planes(0.0, 0, label=True).label
    assert truth is not None
    deck = torch.from_numpy(truth.ravel() == 2)
    assert (said[deck] == TABLE).float().mean() > 0.9


def test_what_cannot_be_fitted_is_refused() -> None:
    far = box(1, "table", (90.0, 0.0, 0.0), (1, 1, 1))
    only_lamps = [replace(f, label=np.full((48, 64), SET.ids[LAMP], np.uint8)) for f in scene()]
    unknown = [replace(f, label=np.full((48, 64), SET.ignore_id, np.uint8)) for f in scene()]
    other = make_label_set("other", ["floor", "table"])
    for error, says, frames, labels, boxes in (
        (ConfigError, r"boxes lie from \(89.46, .*cameras from .*world frame", scene(), SET, (far,)),
        (ConfigError, "needs boxes", scene(), SET, ()),
        (ConfigError, "no class in common: labels say lamp, boxes table", only_lamps, SET, (DECK,)),
        (FrameError, "no frame has a pseudo label", scene(False), SET, (DECK,)),
        (FrameError, r"all pixels of all 8 pseudo labels are unknown \(id 0\)", unknown, SET, (DECK,)),
        (WeightsError, "'deck'.*'other'", scene(), other, (DECK,)),
    ):
        with pytest.raises(error, match=says):
            finetune(frames, labels, empty_field(*boxes), SMALL)
    with pytest.raises(LabelError, match="a box is of class 'table'"):
        Panoptic(PanopticConfig(boxes=(DECK,)), make_label_set("none", ["floor"]))
