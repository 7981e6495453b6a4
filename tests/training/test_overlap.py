import numpy as np
import pytest
import torch

from semantic_mapper.training.overlap import view_overlap
from semantic_mapper.training.step import StepConfig, pick_views
from semantic_mapper.training.views import LabelledView
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(40.0, 40.0, 23.5, 15.5, 48, 32)


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


def test_what_is_hidden_is_not_seen():
    blocked = view(0.0)
    blocked.depth_m[:, :24] = 0.5  # something before the left half
    overlap = view_overlap([view(0.0), blocked])
    assert overlap[0, 1] == pytest.approx(0.5, abs=0.05)


def test_without_depth_views_overlap_where_their_frusta_do():
    overlap = view_overlap([view(0.0, depth_m=0.0), view(0.3, depth_m=0.0), view(0.0, turned=True, depth_m=0.0)])
    assert overlap[0, 1] > 0.5
    assert overlap[0, 2] == 0


def test_views_with_and_without_depth_see_each_other():
    blind, near, wall = view(0.0, depth_m=0.0), view(0.1), view(0.2, depth_m=0.0)
    overlap = view_overlap([blind, near, wall])
    assert overlap[0, 1] > 0.3, "the guesses before the wall are free, those behind it are hidden"
    assert overlap[0, 1] < overlap[0, 2], "a view without depth hides nothing"
    assert overlap[1, 0] > 0.9


def test_source_views_are_drawn_by_what_they_see_of_the_query():
    generator = torch.Generator().manual_seed(0)
    overlap = torch.tensor([[0.0, 0.9, 0.9, 0.0, 0.0]] + [[0.5] * 5] * 4)
    config = StepConfig(views_min=2, views_max=2, own_view_fraction=0.0)
    drawn = [pick_views([0], overlap, config, generator) for _ in range(400)]
    assert {query for query, _ in drawn} == {0}
    assert all(len(set(sources)) == 2 and 0 not in sources for _, sources in drawn)
    counts = np.bincount([i for _, sources in drawn for i in sources], minlength=5)
    assert counts[1:3].min() > 300
    assert counts[3:].min() > 5 and counts[3:].max() < 60, "what sees nothing is drawn seldom, but drawn"


def test_two_views_are_each_others_sources():
    generator = torch.Generator().manual_seed(0)
    config = StepConfig(own_view_fraction=0.0)
    assert {pick_views([0, 1], torch.zeros(2, 2), config, generator)[1][0] for _ in range(20)} == {0, 1}
