"""The image encoder, its backbone, and the surface maps that it sees of measured depth."""

import math
import os
import platform
import subprocess
import sys
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.config import EncoderConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.encoder import ImageEncoder, calibrate
from semantic_mapper.fields.surface_maps import surface_maps
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import CameraIntrinsics, SourceViews
from tests.fields.scene import pose_at, wall_sources
from tests.small import SMALL_ENCODER

SMALL = EncoderConfig(backbone="efficientnet-lite0", channels=(8, 8, 12), blocks=(1, 0, 0), depth=True)
CAMERA = CameraIntrinsics(110.0, 110.0, 79.5, 59.5, 160, 120)
K = camera_matrix(CAMERA).astype(np.float32)
HEIGHT_M = 1.4


def views(count: int, height: int = 24, width: int = 32, seed: int = 0) -> SourceViews:
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor([[20.0, 0, 15.5], [0, 20.0, 11.5], [0, 0, 1]]).expand(count, 3, 3)
    rgb = torch.rand(count, 3, height, width, generator=generator)
    depth = 1 + torch.rand(count, height, width, generator=generator)
    return SourceViews(rgb, depth, K, torch.eye(4).expand(count, 4, 4))


def encoder(config: EncoderConfig = SMALL_ENCODER) -> ImageEncoder:
    torch.manual_seed(0)
    return ImageEncoder(config, 16)


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


def test_calibration_makes_a_fresh_encoder_normalise_and_changes_no_weight():
    field = encoder().eval()
    weights = {name: p.clone() for name, p in field.named_parameters()}
    calibrate(field, views(8))
    assert not field.uncalibrated and not field.training
    assert all(torch.equal(weights[name], p) for name, p in field.named_parameters())
    assert field.depth_net is not None
    seen: list[torch.Tensor] = []
    field.depth_net.stages[0][0].norm1.register_forward_hook(lambda _m, _i, out: seen.append(out))
    with torch.no_grad():
        field(views(8))
    # Running variances count one pixel less than the normalisation does, so not quite 1.
    assert seen[0].mean((0, 2, 3)).abs().max() < 1e-4 and (seen[0].var((0, 2, 3)) - 1).abs().max() < 1e-2


def without_depth(given: SourceViews, *index: int) -> SourceViews:
    depth = given.depth_m.clone()
    depth[list(index)] = 0
    return replace(given, depth_m=depth)


def test_each_view_goes_through_the_network_that_fits_it_and_comes_back_in_its_place():
    field = encoder().eval()
    calibrate(field, views(4))
    mixed = field(without_depth(views(4), 1, 2))
    with_depth, colours = field(views(4)), field(without_depth(views(4), 0, 1, 2, 3))
    torch.testing.assert_close(mixed[[0, 3]], with_depth[[0, 3]], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(mixed[[1, 2]], colours[[1, 2]], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(with_depth[1], colours[1], atol=1e-2)


@pytest.mark.parametrize(("channels", "blocks"), [((), ()), ((8, 8), (1,)), ((8, 0), (1, 1))])
def test_a_shape_that_cannot_be_built_is_refused(channels: tuple[int, ...], blocks: tuple[int, ...]):
    with pytest.raises(ConfigError, match="channels and blocks"):
        encoder(EncoderConfig(channels=channels, blocks=blocks))


def test_computed_depth_is_shown_only_to_an_encoder_that_has_learned_from_it():
    given = views(2)
    none, computed = without_depth(given, 0, 1), replace(given, depth_sigma_m=0.02 * given.depth_m)
    assert torch.equal(encoder()(computed), encoder()(none))
    shown = encoder(msgspec.structs.replace(SMALL_ENCODER, computed_depth=True))
    assert torch.equal(shown(computed), shown(given)) and not torch.equal(shown(computed), shown(none))


def test_a_frozen_backbone_keeps_weights_and_statistics_while_the_rest_learns():
    encoder = ImageEncoder(SMALL, 8)
    encoder.freeze(encoder.colour_net, *encoder.backbones())
    encoder.freeze(*encoder.backbones())
    before = {name: t.clone() for name, t in encoder.state_dict().items()}
    optimiser = torch.optim.AdamW(encoder.parameters(), 0.1, weight_decay=0.1)
    views = wall_sources([pose_at(0.0), pose_at(0.1)])
    with encoder.batch_statistics():
        encoder(views).square().sum().backward()
    optimiser.step()
    changed = {name for name, t in encoder.state_dict().items() if not torch.equal(t, before[name])}
    assert not any("backbone" in name for name in changed)
    assert "depth_net.stem.weight" in changed and "depth_net.stages.0.0.norm1.running_mean" in changed


def floor_depth(pitch: float) -> torch.Tensor:
    """Depth (H, W) of a level floor below a camera that is inclined downwards; 0 where the ray does not fall."""
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    ray = torch.stack(((u - 79.5) / 110, (v - 59.5) / 110, torch.ones_like(u)))
    falls = torch.einsum("ihw,i->hw", ray, torch.tensor([0.0, math.cos(pitch), math.sin(pitch)]))
    return torch.where(falls > 0.05, HEIGHT_M / falls.clamp_min(0.05), 0)


@pytest.mark.parametrize("pitch_deg", [0, 15, 40])
def test_a_level_floor_is_level_at_height_nought_and_faces_up(pitch_deg: int):
    depth = floor_depth(math.radians(pitch_deg))
    inverse, measured, height, level, facing = torch.from_numpy(surface_maps(depth.numpy(), K))
    seen = depth > 0
    assert torch.equal(measured, seen.float())
    torch.testing.assert_close(inverse[seen], 1 / depth[seen])
    assert float(height[seen].abs().max()) < 0.02
    inner = level != 0  # beside holes and at the border there is no normal
    assert inner.float().mean() > 0.3
    assert float(level[inner].min()) > 0.999
    assert (facing[inner] + math.sin(math.radians(pitch_deg))).abs().max() < 2e-2


def test_without_depth_there_is_nothing_and_holes_stay_holes():
    assert not surface_maps(np.zeros((24, 32), np.float32), K).any()
    depth = floor_depth(0.5).numpy()
    depth[70:80, 60:90] = 0
    maps = surface_maps(depth, K)
    assert np.isfinite(maps).all() and not maps[:, 70:80, 60:90].any() and maps.any()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="processors without AVX are x86-64")
def test_the_mapper_encodes_on_a_processor_without_avx() -> None:
    code = "from semantic_mapper import Mapper, open_log; from semantic_mapper.replay.log import demo_log\n"
    code += "m = Mapper.load()\nwith open_log(demo_log()) as log: print(m.step(log.frame(0)).label.shape)"
    limited = os.environ | {"ONEDNN_MAX_CPU_ISA": "SSE41", "ATEN_CPU_CAPABILITY": "default"}
    done = subprocess.run([sys.executable, "-c", code], env=limited, capture_output=True, text=True, check=False)
    assert "(240, 320)" in done.stdout, done.stderr
