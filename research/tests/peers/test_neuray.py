from dataclasses import replace

import pytest
import torch

from research.peers.neuray import NeuRay, visibility_share
from research.peers.rendering import weighted_moments
from research.tests.peers.tiny_peers import tiny_peer
from semantic_mapper.fields.sray import contextual_space
from tests.fields.scene import WALL_M, pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import AWAY, POSES, assert_gradients_are_right, assert_unknown


def neuray() -> NeuRay:
    field = tiny_peer("neuray")
    assert isinstance(field, NeuRay)
    return field


@pytest.mark.parametrize("views", [1, 2, 7, 16])
@pytest.mark.parametrize("with_depth", [True, False])
def test_any_number_of_views_from_1_to_16_renders_with_and_without_depth(views: int, with_depth: bool):
    field = neuray()
    encoded = field.encode(wall_sources([pose_at(0.02 * i) for i in range(views)], with_depth=with_depth))
    render = field.render(wall_rays(pose_at(0.0), step=101, prior=WALL_M * with_depth), encoded)
    assert render.logits.shape == (16, 3)
    assert all(torch.isfinite(t).all() for t in (render.logits, render.depth_m, render.rgb, render.entropy))
    assert render.known.all()


def test_a_ray_that_no_view_sees_is_unknown():
    field = neuray()
    assert_unknown(field.render(wall_rays(AWAY, step=53), field.encode(wall_sources(POSES))))


def test_untrained_field_already_renders_measured_depth():
    field = neuray()
    render = field.render(wall_rays(pose_at(0.0), step=31), field.encode(wall_sources(POSES)))
    seen = render.opacity > 0.5
    assert seen.float().mean() > 0.8
    assert (render.depth_m[seen] - WALL_M).abs().median() < 0.03


def test_a_blind_view_and_the_order_of_views_change_nothing():
    field = neuray()
    rays = wall_rays(pose_at(0.0), step=31)
    seeing = field.encode(wall_sources(POSES))
    with_blind = field.encode(wall_sources([*POSES, AWAY]))
    expected = field.render(rays, seeing).logits
    torch.testing.assert_close(field.render(rays, with_blind).logits, expected, atol=1e-5, rtol=1e-4)
    shuffled = field.render(rays, seeing.select(torch.tensor([2, 0, 3, 1]))).logits
    torch.testing.assert_close(shuffled, expected, atol=1e-5, rtol=1e-4)


def test_views_that_a_sample_is_hidden_from_hardly_count():
    """The wall at 2 m hides from one view what the others, which have no wall there, see free."""
    visibility = torch.tensor([0.9, 0.9, 0.0]).view(3, 1, 1)
    fraction = visibility_share(visibility, torch.ones(3, 1, 1, dtype=torch.bool))[:, 0, 0]
    torch.testing.assert_close(fraction, torch.tensor([0.5, 0.5, 0.0]), atol=1e-3, rtol=0)
    hidden = visibility_share(torch.zeros(3, 1, 1), torch.tensor([True, True, False]).view(3, 1, 1))[:, 0, 0]
    torch.testing.assert_close(hidden, torch.tensor([0.5, 0.5, 0.0]))


def test_moments_are_those_of_the_views_that_count():
    values = torch.randn(5, 2, 3, 4)
    valid = torch.tensor([True, True, True, False, True])[:, None, None].expand(5, 2, 3)
    mean, var = weighted_moments(values, valid / valid.sum(0))
    torch.testing.assert_close(mean, values[[0, 1, 2, 4]].mean(0))
    torch.testing.assert_close(var, values[[0, 1, 2, 4]].var(0, unbiased=False))
    nothing = weighted_moments(values, torch.zeros(5, 2, 3))
    assert nothing[0].abs().max() == 0 and nothing[1].abs().max() == 0


def test_source_logits_are_those_of_a_ray_of_the_view_itself_that_surely_ends():
    field = neuray()
    encoded = field.encode(wall_sources(POSES[:1]))
    own = field.source_logits(encoded)
    assert own.shape == (1, 3, 16, 24)
    # The centre of feature pixel (5, 7) is the corner between image pixels (11, 15) and (10, 14).
    row = torch.tensor([10 * 48 + 14, 10 * 48 + 15, 11 * 48 + 14, 11 * 48 + 15])
    rays = wall_rays(POSES[0])
    middle = replace(
        rays,
        **{n: getattr(rays, n)[row].mean(0, keepdim=True) for n in ("origin", "direction", "near_m", "far_m")},
    )
    space = contextual_space(middle, torch.tensor([[1.0, WALL_M, 3.0]]), encoded)
    cues = torch.cat((torch.ones_like(space.cues[..., :3]), space.cues[..., 3:]), dim=-1)
    _, sample = field.aggregate(space.feature, cues, torch.ones_like(space.visibility), space.valid)
    logits = field.classifier(field.semantic(sample))[0, 1]
    torch.testing.assert_close(logits, own[0, :, 5, 7], atol=1e-4, rtol=1e-4)


def test_the_whole_field_passes_gradcheck():
    assert_gradients_are_right(neuray())
