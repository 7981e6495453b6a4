import math
from dataclasses import replace

import torch

from semantic_mapper.labels import ROOMS
from semantic_mapper.training.losses import LossConfig, ray_loss, semantic_loss
from semantic_mapper.training.step import StepConfig, _sources
from semantic_mapper.training.views import (
    RayTargets,
    draw_hard_examples,
    draw_pixels,
    jitter_colours,
    query_rays,
    stack_sources,
    view_from_frame,
    withhold_depth,
)
from semantic_mapper.types import FieldRender
from tests.small import tiny_frames


def render(logits: torch.Tensor, known: torch.Tensor | None = None) -> FieldRender:
    n = len(logits)
    known = torch.ones(n, dtype=torch.bool) if known is None else known
    return FieldRender(logits, torch.full((n,), 2.0), torch.ones(n), torch.full((n, 3), 0.5), torch.zeros(n), known)


def test_cross_entropy_matches_a_hand_computed_case_with_ignored_rays():
    logits = torch.tensor([[0.0, math.log(3)], [5.0, -5.0], [0.0, 0.0]])
    loss = semantic_loss(logits, torch.tensor([1, -1, 0]))
    torch.testing.assert_close(loss, torch.tensor((math.log(4 / 3) + math.log(2)) / 2))


def test_all_rays_ignored_gives_zero_loss_with_zero_gradient():
    logits = torch.randn(3, 2, requires_grad=True)
    semantic_loss(logits, torch.full((3,), -1)).backward()
    assert logits.grad.abs().max() == 0


def test_unknown_rays_do_not_count():
    targets = RayTargets(torch.tensor([0, 1]), torch.full((2, 3), 0.5), torch.tensor([2.0, 2.0]))
    logits = torch.tensor([[9.0, -9.0], [9.0, -9.0]])
    both = ray_loss(render(logits), targets, LossConfig())
    first = ray_loss(render(logits, torch.tensor([True, False])), targets, LossConfig())
    assert both.semantic > 5 and first.semantic < 1e-3


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


def test_doubtful_draws_go_where_the_doubt_is():
    doubt = torch.zeros(10, 10)
    doubt[3, 4], doubt[7, 1] = 3.0, 1.0
    drawn = draw_hard_examples(doubt, 4000, torch.Generator().manual_seed(0))
    assert set(drawn.tolist()) == {34, 71}
    assert abs((drawn == 34).float().mean() - 0.75) < 0.03


def test_query_rays_carry_the_targets_of_their_pixels():
    view = view_from_frame(tiny_frames()[0], ROOMS, 96)
    flat = torch.tensor([0, 97, 3000])
    rays, targets = query_rays(view, flat, near_m=0.3, far_m=8, prior=None)
    v, u = 3000 // 96, 3000 % 96
    assert targets.channel[2] == view.channel[v, u]
    torch.testing.assert_close(targets.rgb[2], view.rgb[:, v, u])
    point = rays.origin[2] + view.depth_m[v, u] * rays.direction[2]
    camera = torch.linalg.inv(view.T_world_camera) @ torch.cat((point, torch.ones(1)))
    k = view.intrinsics
    torch.testing.assert_close(camera[2], view.depth_m[v, u])
    torch.testing.assert_close(k.fx * camera[0] / camera[2] + k.cx, torch.tensor(float(u)), atol=1e-3, rtol=1e-4)


def test_depth_is_withheld_by_view_and_colours_stay_in_range():
    sources = stack_sources([view_from_frame(f, ROOMS, 96) for f in tiny_frames()])
    generator = torch.Generator().manual_seed(0)
    assert withhold_depth(sources, 1.0, generator).depth_m.max() == 0
    assert torch.equal(withhold_depth(sources, 0.0, generator).depth_m, sources.depth_m)
    jittered = jitter_colours(sources, 0.3, generator).rgb
    assert jittered.min() >= 0 and jittered.max() <= 1
    assert not torch.equal(jittered, sources.rgb)


def test_unlabelled_frame_becomes_all_ignore():
    view = view_from_frame(replace(tiny_frames()[0], label=None), ROOMS, 48)
    assert (view.channel == -1).all() and view.rgb.shape == (3, 36, 48)


def test_labels_are_known_of_other_source_views_but_never_of_the_query_itself():
    views = [view_from_frame(f, ROOMS, 48) for f in tiny_frames(3)]
    config = StepConfig(label_dropout=0.0)
    stacked = _sources(views, 1, [0, 1, 2], config, torch.Generator().manual_seed(0))
    assert (stacked.channel[1] == -1).all()
    assert torch.equal(stacked.channel[0], views[0].channel) and torch.equal(stacked.channel[2], views[2].channel)
    none = _sources(views, 1, [0, 2], StepConfig(label_dropout=1.0), torch.Generator().manual_seed(0))
    assert (none.channel == -1).all()
