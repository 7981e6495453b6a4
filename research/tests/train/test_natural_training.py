"""What keeps training honest: natural class frequencies, spoiled current frames, a resting colour network."""

from __future__ import annotations

from dataclasses import replace

import torch

from research.train.step import StepConfig, pick_views_on_path
from research.train.view_draws import degrade_view, natural_weights
from semantic_mapper.config import EncoderConfig, SRayConfig
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.losses import guess_loss
from semantic_mapper.training.views import draw_pixels
from semantic_mapper.types import SourceViews
from tests.fields.scene import pose_at, wall_sources
from tests.small import SMALL_ENCODER


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def source_views(count: int = 3, size: tuple[int, int] = (24, 32)) -> SourceViews:
    draw = generator(1)
    K = torch.tensor([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]).expand(count, 3, 3)
    depth = 1 + torch.rand(count, *size, generator=draw)
    return SourceViews(torch.rand(count, 3, *size, generator=draw), depth, K, torch.eye(4).expand(count, 4, 4))


def test_weighted_rays_have_the_class_frequencies_of_the_image() -> None:
    channel = torch.zeros(40, 50, dtype=torch.int64)
    channel[:, 45:] = 3
    channel[:2, :10] = 7
    channel[30:, :5] = -1
    natural = torch.bincount(channel[channel >= 0], minlength=8) / (channel >= 0).sum()
    flat = draw_pixels(channel, 40_000, 0.5, generator(), 8)
    drawn = channel.flatten()[flat]
    assert (drawn == 7).float().mean() > 5 * natural[7]
    weight = natural_weights(drawn, channel, 0.5)
    found = torch.zeros(8).scatter_add(0, drawn, weight) / weight.sum()
    torch.testing.assert_close(found, natural, atol=0.01, rtol=0)
    assert natural_weights(drawn, channel, 0.0).eq(1).all()


def test_a_degraded_view_is_spoiled_and_the_others_are_not() -> None:
    views = source_views()
    without_depth = 0
    for seed in range(30):
        spoiled = degrade_view(views, 1, generator(seed))
        assert torch.equal(spoiled.rgb[[0, 2]], views.rgb[[0, 2]]) and torch.equal(spoiled.depth_m[0], views.depth_m[0])
        assert float(spoiled.rgb.min()) >= 0 and float(spoiled.rgb.max()) <= 1
        assert float((spoiled.rgb[1] - views.rgb[1]).abs().mean()) > 0.01
        without_depth += not spoiled.depth_m[1].any()
    assert 3 < without_depth < 20
    assert torch.equal(degrade_view(views, 1, generator(4)).rgb, degrade_view(views, 1, generator(4)).rgb)


def test_wide_steps_leave_out_the_nearer_half_of_the_path() -> None:
    wide = StepConfig(views_min=3, views_max=3, own_view_fraction=0, wide_fraction=1.0)
    for seed in range(20):
        query, sources = pick_views_on_path([6], 13, wide, generator(seed))
        assert query == 6 and all(abs(i - 6) >= 3 for i in sources)
    own = StepConfig(views_min=3, views_max=3, own_view_fraction=1.0, wide_fraction=1.0)
    assert pick_views_on_path([6], 13, own, generator())[1][-1] == 6


def test_a_frozen_colour_network_keeps_weights_and_statistics_while_the_other_learns() -> None:
    encoder = ImageEncoder(EncoderConfig(channels=(8, 8), blocks=(1, 1), depth=True), 8)
    views = source_views(4)
    views = SourceViews(
        views.rgb, views.depth_m * torch.tensor([1.0, 1, 0, 0])[:, None, None], views.K, views.T_world_camera
    )
    encoder.freeze(encoder.colour_net)
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    optimiser = torch.optim.AdamW(encoder.parameters(), lr=0.1)
    with encoder.batch_statistics():
        encoder(views).square().mean().backward()
    optimiser.step()
    changed = {
        name.split(".")[0] for name, tensor in encoder.state_dict().items() if not torch.equal(tensor, before[name])
    }
    assert changed == {"depth_net"}
    encoder.freeze()
    with encoder.batch_statistics():
        encoder(views).square().mean().backward()
    assert all(p.grad is not None for p in encoder.colour_net.parameters())


def test_the_depth_of_views_without_any_is_learned_where_it_was_measured() -> None:
    geometry = torch.full((2, 5, 4, 6), 2.0)
    geometry[:, 1] = 0.2
    geometry.requires_grad_(True)
    measured = torch.full((2, 8, 12), 3.0)
    measured[:, :4] = 0
    given = torch.zeros(2, 8, 12)
    given[1] = measured[1]
    loss = guess_loss(geometry, given, measured)
    loss.backward()
    assert geometry.grad is not None
    torch.testing.assert_close(loss.detach(), torch.tensor(1.5).log() / 0.1 + torch.tensor(0.1).log())
    assert not geometry.grad[1].any() and not geometry.grad[0, :, :2].any()  # it was given, or nobody knows
    assert (geometry.grad[0, 0, 2:] < 0).all() and (geometry.grad[0, 1, 2:] < 0).all()  # farther, and less sure
    assert guess_loss(geometry, measured, measured) == 0


def test_a_lens_of_twice_the_focal_length_guesses_twice_the_depth() -> None:
    torch.manual_seed(0)
    field = SRay(SRayConfig(feature_dim=8, heads=2, encoder=SMALL_ENCODER), ROOMS).eval()
    views = wall_sources([pose_at(0.0)])
    views = replace(views, depth_m=torch.zeros_like(views.depth_m))
    K = views.K.clone()
    K[:, :2, :2] *= 2
    near, far = (field.encode(v).geometry[:, 0] for v in (views, replace(views, K=K)))
    torch.testing.assert_close(far, 2 * near)
