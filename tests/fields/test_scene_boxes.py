"""Samples of boxes that move among those of the scene: what is in front dims what is behind."""

import numpy as np
import pytest
import torch

from semantic_mapper.fields.scene.boxes import MovingBoxes
from semantic_mapper.fields.scene.grid import RaySamples
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.types import RayBatch


def box(x: float, size: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> MovingBoxes:
    """One box that stops all light, at x at time 0 and 1 m higher at time 10."""
    low, high = np.eye(4), np.eye(4)
    low[:3, 3], high[:3, 3] = (x, 0, 0), (x, 0, 1)
    boxes = MovingBoxes([Primitive(1, "car", "box", low, np.array(size), True, stamps=((0, low), (10, high)))], 0.2)
    boxes.grid(0).values[..., 0] = 12.0
    boxes.grid(0).update_occupied()
    return boxes


def scene(stamp_ns: int | None) -> RaySamples:
    """Two rays along x, one 50 m aside; the scene stops half of their light at x = 2 m."""
    origin = torch.tensor([(0.0, 0.0, 0.0), (0.0, 50.0, 0.0)])
    none = torch.zeros(2)
    along = torch.tensor([(1.0, 0.0, 0.0)] * 2)
    rays = RayBatch(origin, along, none, none + torch.inf, none, stamp_ns=stamp_ns)
    half = torch.full((2, 1), 0.5)
    return RaySamples(rays, torch.ones(2, 1, 3), 4 * half, half, half[:, 0])


@pytest.mark.parametrize(("x", "of_scene", "of_box"), [(4.0, 0.5, 0.5), (1.0, 0.0, 1.0)])
def test_what_is_in_front_dims_what_is_behind(x: float, of_scene: float, of_box: float) -> None:
    found = box(x).composite(scene(0), 8)
    assert found.mover is not None
    still = (found.weight * (found.mover < 0)).sum(1)
    assert still.tolist() == pytest.approx([of_scene, 0.5], abs=1e-3)
    assert (found.weight * (found.mover == 0)).sum(1).tolist() == pytest.approx([of_box, 0.0], abs=1e-3)
    torch.testing.assert_close(found.weight.sum(1) + found.light, torch.ones(2), atol=1e-3, rtol=0)
    assert (found.z.diff() >= 0).all()


@pytest.mark.parametrize("stamp_ns", [None, 8, 16])
def test_a_box_that_is_elsewhere_or_nowhere_changes_nothing_and_an_unfilled_one_is_empty(stamp_ns: int | None) -> None:
    before = scene(stamp_ns)
    assert box(4.0).composite(before, 8) is before
    found = MovingBoxes(box(1.0).primitives, 0.2).composite(scene(0), 8)
    assert found.light.tolist() == found.weight.sum(1).tolist() == [0.5, 0.5]
