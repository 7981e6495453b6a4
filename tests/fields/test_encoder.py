from dataclasses import replace

import msgspec
import pytest
import torch

from semantic_mapper.config import EncoderConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.encoder import ImageEncoder, calibrate, has_depth
from semantic_mapper.types import SourceViews
from tests.small import SMALL_ENCODER


def views(count: int, height: int = 24, width: int = 32, seed: int = 0) -> SourceViews:
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[20.0, 0, 15.5], [0, 20.0, 11.5], [0, 0, 1]]).expand(count, 3, 3)
    rgb = torch.rand(count, 3, height, width, generator=generator)
    depth = 1 + torch.rand(count, height, width, generator=generator)
    return SourceViews(rgb, depth, K, torch.eye(4).expand(count, 4, 4))


def encoder(config: EncoderConfig = SMALL_ENCODER) -> ImageEncoder:
    torch.manual_seed(0)
    return ImageEncoder(config, 16)


@pytest.mark.parametrize("size", [(24, 32), (23, 31), (9, 13)])
def test_features_have_half_the_size_rounded_up(size: tuple[int, int]):
    config = EncoderConfig(channels=(8, 8, 8), blocks=(1, 1, 1))
    feature = encoder(config)(views(2, *size))
    assert feature.shape == (2, 16, -(-size[0] // 2), -(-size[1] // 2))


def test_a_views_features_do_not_depend_on_the_views_beside_it_in_training_mode_either():
    field = encoder()
    calibrate(field, views(4))
    for mode in (True, False):
        field.train(mode)
        together = field(views(4))
        alone = field(SourceViews(*(getattr(views(4), n)[1:2] for n in ("rgb", "depth_m", "K", "T_world_camera"))))
        torch.testing.assert_close(together[1:2], alone, atol=1e-5, rtol=1e-4)


def test_statistics_change_inside_batch_statistics_and_nowhere_else():
    field = encoder()  # as built: in training mode
    before = {name: t.clone() for name, t in field.named_buffers()}
    field(views(3))
    assert all(torch.equal(before[name], t) for name, t in field.named_buffers())
    assert field.uncalibrated
    with field.batch_statistics():
        field(without_depth(views(3), 0))
    assert not all(torch.equal(before[name], t) for name, t in field.named_buffers())
    assert not field.uncalibrated and field.training
    assert not any(m.training for m in field.modules() if isinstance(m, torch.nn.BatchNorm2d))


def test_a_backbone_with_statistics_of_its_own_is_calibrated_though_it_has_counted_no_batch():
    field = encoder(EncoderConfig(channels=(8, 8), blocks=(1, 0), backbone="efficientnet-lite0"))
    for backbone in field.backbones():
        for module in backbone.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                assert module.running_mean is not None
                module.running_mean.fill_(0.1)  # as published weights bring it, their count is not among them
    field.freeze_backbones()
    assert field.uncalibrated, "the other norms are fresh"
    calibrate(field, views(2))
    assert not field.uncalibrated


def test_calibration_makes_a_fresh_encoder_normalise_and_changes_no_weight():
    field = encoder().eval()
    weights = {name: p.clone() for name, p in field.named_parameters()}
    calibrate(field, views(8))
    assert not field.uncalibrated and not field.training
    assert all(torch.equal(weights[name], p) for name, p in field.named_parameters())
    assert field.depth_net is not None
    norm = field.depth_net.stages[0][0].norm1
    seen: list[torch.Tensor] = []
    norm.register_forward_hook(lambda _m, _i, out: seen.append(out))
    with torch.no_grad():
        field(views(8))
    # Running variances count one pixel less than the normalisation does, so not quite 1.
    torch.testing.assert_close(seen[0].mean((0, 2, 3)), torch.zeros(8), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen[0].var((0, 2, 3)), torch.ones(8), atol=1e-2, rtol=0)


def test_only_an_encoder_that_sees_depth_is_moved_by_it():
    for depth in (True, False):
        field = encoder(EncoderConfig(channels=(8,), blocks=(1,), depth=depth)).eval()
        near, far = views(1), views(1)
        far = SourceViews(far.rgb, far.depth_m * 2, far.K, far.T_world_camera)
        assert torch.equal(field(near), field(far)) is not depth


def without_depth(given: SourceViews, *index: int) -> SourceViews:
    depth = given.depth_m.clone()
    depth[list(index)] = 0
    return replace(given, depth_m=depth)


def test_each_view_goes_through_the_network_that_fits_it_and_comes_back_in_its_place():
    field = encoder().eval()
    calibrate(field, views(4))
    assert field.depth_net is not None
    mixed = field(without_depth(views(4), 1, 2))
    with_depth, colours = field(views(4)), field(without_depth(views(4), 0, 1, 2, 3))
    torch.testing.assert_close(mixed[[0, 3]], with_depth[[0, 3]], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(mixed[[1, 2]], colours[[1, 2]], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(with_depth[1], colours[1], atol=1e-2)


def test_a_view_with_a_few_measured_pixels_counts_as_one_without_depth():
    field = encoder().eval()
    few = torch.zeros(2, 24, 32)
    few[:, 0, :9] = 1.5  # 1.2 % of the pixels
    assert not has_depth(few).any()
    none = without_depth(views(2), 0, 1)
    assert torch.equal(field(replace(none, depth_m=few)), field(none))


def test_the_network_for_depth_begins_where_the_one_for_colours_is_and_then_goes_its_own_way():
    field = encoder().eval()
    calibrate(field, views(4))
    field.grow_depth()
    none = without_depth(views(4), 0, 1, 2, 3)
    torch.testing.assert_close(field(views(4)), field(none), atol=1e-5, rtol=1e-4)
    field(views(4)).square().sum().backward()
    assert field.depth_net is not None
    surface = field.depth_net.stem.weight.grad
    assert surface is not None and surface[:, 3:].abs().max() > 0, "what ignores depth now has to be able to learn it"
    assert field.colour_net.stem.weight.grad is None


def test_an_encoder_of_colours_alone_has_no_network_to_grow():
    with pytest.raises(ConfigError, match="depth = true"):
        encoder(EncoderConfig(channels=(8,), blocks=(1,))).grow_depth()


@pytest.mark.parametrize(
    "config",
    [
        EncoderConfig(channels=(), blocks=()),
        EncoderConfig(channels=(8, 8), blocks=(1,)),
        EncoderConfig(channels=(8, 0), blocks=(1, 1)),
    ],
)
def test_a_shape_that_cannot_be_built_is_refused(config: EncoderConfig):
    with pytest.raises(ConfigError, match="channels and blocks"):
        encoder(config)


def computed(given: SourceViews, spread: float) -> SourceViews:
    return replace(given, depth_sigma_m=spread * given.depth_m)


def test_computed_depth_is_shown_only_to_an_encoder_that_has_learned_from_it():
    given = views(2)
    none = without_depth(given, 0, 1)
    assert torch.equal(encoder()(computed(given, 0.02)), encoder()(none))
    shown = encoder(msgspec.structs.replace(SMALL_ENCODER, computed_depth=True))
    assert torch.equal(shown(computed(given, 0.02)), shown(given))
    assert not torch.equal(shown(computed(given, 0.02)), shown(none))


def test_computed_depth_that_is_not_sure_is_a_hole():
    shown = encoder(msgspec.structs.replace(SMALL_ENCODER, computed_depth=True))
    given = views(2)
    spread = torch.full_like(given.depth_m, 0.02)
    spread[:, :10] = 0.2
    holes = given.depth_m.clone()
    holes[:, :10] = 0
    partly = replace(given, depth_sigma_m=spread * given.depth_m)
    assert torch.equal(shown(partly), shown(replace(given, depth_m=holes)))


def test_a_measured_view_beside_computed_ones_is_shown_as_it_is():
    given = views(2)
    spread = torch.zeros_like(given.depth_m)
    spread[1] = 0.02 * given.depth_m[1]
    assert torch.equal(encoder()(replace(given, depth_sigma_m=spread)), encoder()(without_depth(given, 1)))
