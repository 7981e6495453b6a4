import pytest
import torch

from semantic_mapper.config import EncoderConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.encoder import ImageEncoder, calibrate
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
        field(views(3))
    assert not all(torch.equal(before[name], t) for name, t in field.named_buffers())
    assert not field.uncalibrated and field.training
    assert not any(m.training for m in field.modules() if isinstance(m, torch.nn.BatchNorm2d))


def test_calibration_makes_a_fresh_encoder_normalise_and_changes_no_weight():
    field = encoder().eval()
    weights = {name: p.clone() for name, p in field.named_parameters()}
    calibrate(field, views(8))
    assert not field.uncalibrated and not field.training
    assert all(torch.equal(weights[name], p) for name, p in field.named_parameters())
    norm = field.stages[0][0].norm1
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
