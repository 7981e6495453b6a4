from dataclasses import replace

import torch

from research.train.step import LossConfig, StepBatch, batch_loss, draw_batch, pick_views_on_path
from research.train.train_config import TrainStepConfig
from semantic_mapper.config import convert_config
from semantic_mapper.fields.device import compute_in_bfloat16
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.views import stack_sources, view_from_frame
from tests.small import tiny_field, tiny_frames

VIEWS = [view_from_frame(f, ROOMS, 48) for f in tiny_frames()]


def batch(seed: int = 0, sources: tuple[int, ...] = (0, 2, 3), **changes: object) -> StepBatch:
    step = convert_config({"rays": 64, "no_depth": 0.0, "depth_dropout": 0.0, **changes}, TrainStepConfig, "test")
    generator = torch.Generator().manual_seed(seed)
    drawn = draw_batch(VIEWS, 1, sources, step, generator, len(ROOMS), torch.device("cpu"))
    assert drawn is not None
    return drawn


def test_source_views_are_three_to_twelve_near_and_far_and_rarely_the_query_itself():
    generator = torch.Generator().manual_seed(0)
    sizes, spreads, own = set(), [], 0
    for _ in range(2000):
        query, sources = pick_views_on_path(range(20), 20, TrainStepConfig(own_view_fraction=0.2), generator)
        assert len(set(sources)) == len(sources)
        own += query in sources
        sizes.add(len(sources))
        if len(sources) == 4 and 6 <= query <= 13:
            spreads.append(max(abs(i - query) for i in sources))
    assert sizes == set(range(3, 13))
    assert 0.15 < own / 2000 < 0.25
    assert min(spreads) == 2 and max(spreads) >= 10, "from the nearest views to the whole path"


def test_the_query_is_one_of_the_given_views_and_short_paths_are_used_up():
    generator = torch.Generator().manual_seed(0)
    drawn = [pick_views_on_path([1, 3], 4, TrainStepConfig(own_view_fraction=0), generator) for _ in range(40)]
    assert {q for q, _ in drawn} == {1, 3}
    assert all(len(s) == 3 and q not in s for q, s in drawn)


def test_a_blind_step_has_no_depth_anywhere_and_fewer_rays():
    seeing = batch()
    assert (seeing.sources.depth_m > 0).any() and (seeing.rays.prior_depth_m > 0).any()
    assert seeing.z.shape == (64, 8)
    blind = batch(no_depth=1.0, no_depth_thinning=4, samples_without_depth=32)
    assert blind.sources.depth_m.max() == 0 and blind.rays.prior_depth_m.max() == 0
    assert blind.z.shape == (16, 32) and len(blind.targets.channel) == 16
    assert (blind.targets.depth_m > 0).any(), "depth is withheld from the field, not from the loss"


def test_source_images_come_from_the_copies_on_the_device_and_targets_from_the_host():
    bright = [replace(view, rgb=torch.ones_like(view.rgb)) for view in VIEWS]
    step = TrainStepConfig(rays=64, colour_jitter=0.0)
    generator = torch.Generator().manual_seed(0)
    drawn = draw_batch(VIEWS, 1, (0, 2), step, generator, len(ROOMS), torch.device("cpu"), bright)
    assert drawn is not None
    assert drawn.sources.rgb.min() == 1 and drawn.targets.rgb.min() < 1


def test_rooms_encoded_together_give_the_loss_and_gradient_of_rooms_encoded_one_by_one():
    batches = [batch(0), batch(1, (0, 4)), batch(2, (5, 4, 3, 2))]
    gradients, totals = [], []
    for together in (False, True):
        model = tiny_field()
        loss = batch_loss(model, batches, LossConfig(), encode_together=together)
        loss.total.backward()
        totals.append(loss)
        gradients.append({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
    for part in ("total", "semantic", "colour", "depth"):
        torch.testing.assert_close(getattr(totals[0], part), getattr(totals[1], part))
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        torch.testing.assert_close(gradient, gradients[1][name], rtol=1e-3, atol=1e-5)


def test_the_loss_of_several_rooms_is_the_mean_of_their_losses():
    batches, model = [batch(0), batch(1)], tiny_field()
    alone = [batch_loss(model, [b], LossConfig()).total for b in batches]
    torch.testing.assert_close(batch_loss(model, batches, LossConfig()).total, (alone[0] + alone[1]) / 2)


def test_named_parts_compute_in_bfloat16_and_hand_back_float32():
    exact, rounded = tiny_field(), tiny_field()
    compute_in_bfloat16(rounded, ("encoder", "radial"), "cpu")
    sources = stack_sources(VIEWS[:3])
    a, b = exact.encode(sources), rounded.encode(sources)
    assert b.feature.dtype == torch.float32 and not torch.equal(a.feature, b.feature)
    assert (a.feature - b.feature).abs().max() < 0.05 * a.feature.abs().max()
    assert torch.equal(a.T_camera_world, b.T_camera_world), "geometry stays exact"
    loss = batch_loss(rounded, [batch()], LossConfig()).total
    loss.backward()
    assert loss.dtype == torch.float32 and torch.isfinite(loss)
    assert rounded.state_dict().keys() == exact.state_dict().keys()
