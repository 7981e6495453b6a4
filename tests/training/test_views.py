import math

import numpy as np
import pytest
import torch

from semantic_mapper.training.finetune import pick_views
from semantic_mapper.training.losses import semantic_loss
from semantic_mapper.training.views import LabelledView, draw_pixels, view_overlap
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(40.0, 40.0, 23.5, 15.5, 48, 32)


def test_cross_entropy_matches_a_hand_computed_case_with_ignored_rays():
    logits = torch.tensor([[0.0, math.log(3)], [5.0, -5.0], [0.0, 0.0]])
    loss = semantic_loss(logits, torch.tensor([1, -1, 0]))
    torch.testing.assert_close(loss, torch.tensor((math.log(4 / 3) + math.log(2)) / 2))


def test_balanced_draws_show_rare_classes_as_often_as_common_ones():
    channel = torch.zeros(100, 100, dtype=torch.int64)
    channel[:2, :5] = 1
    channel[50:] = -1
    generator = torch.Generator().manual_seed(0)
    drawn = channel.flatten()[draw_pixels(channel, 2000, 1.0, generator, 5)]
    assert (drawn >= 0).all()
    assert abs((drawn == 1).float().mean() - 0.5) < 0.05
    uniform = channel.flatten()[draw_pixels(channel, 2000, 0.0, generator, 5)]
    assert (uniform == 1).float().mean() < 0.02


def view(x: float, *, turned: bool = False, depth_m: float = 2.0) -> LabelledView:
    """A camera ``x`` metres to the right that sees a wall 2 m ahead (2.4 m wide), or looks away from it."""
    T = torch.eye(4)
    if turned:
        T[0, 0] = T[2, 2] = -1
    T[0, 3] = x
    return LabelledView(
        torch.zeros(3, 32, 48), torch.full((32, 48), depth_m), torch.zeros(32, 48, dtype=torch.int64), CAMERA, T
    )


def test_overlap_is_the_share_of_a_view_that_another_sees():
    overlap = view_overlap([view(0.0), view(0.6), view(0.0, turned=True)])
    assert overlap.diagonal().tolist() == [0, 0, 0]
    assert overlap[0, 1] == pytest.approx(0.75, abs=0.05), "moved by a quarter of the width"
    assert overlap[1, 0] == pytest.approx(0.75, abs=0.05)
    assert overlap[0, 2] == overlap[2, 0] == 0


def test_source_views_are_drawn_by_what_they_see_of_the_query():
    generator = torch.Generator().manual_seed(0)
    overlap = torch.tensor([[0.0, 0.9, 0.9, 0.0, 0.0]] + [[0.5] * 5] * 4)
    drawn = [pick_views([0], overlap, generator, own_view_fraction=0.0) for _ in range(400)]
    assert {query for query, _ in drawn} == {0}
    assert all(len(set(sources)) == len(sources) and 0 not in sources for _, sources in drawn)
    counts = np.bincount([i for _, sources in drawn for i in sources], minlength=5)
    assert counts[1:3].min() > 350
    assert counts[3:].min() > 5 and counts[3:].max() < counts[1:3].min(), "what sees nothing is drawn seldom, but drawn"
