"""Tiny fields of every kind, and what tests of several kinds share."""

from dataclasses import replace

import msgspec
import torch

from semantic_mapper.config import (
    Config,
    EncoderConfig,
    GridConfig,
    GridFieldConfig,
    IRTConfig,
    PanopticConfig,
    SamplingConfig,
    SRayConfig,
    UNetFieldConfig,
)
from semantic_mapper.fields.learned import LearnedField, build_field
from semantic_mapper.fields.volume import sample_guided
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.types import FieldRender, RayBatch, SourceViews
from tests.fields.scene import pose_at, wall_rays, wall_sources
from tests.small import SMALL_ENCODER

TINY_IRT = IRTConfig(
    grid=GridConfig(origin_m=(-2.0, -2.0, -1.0), voxel_m=0.25, shape=(17, 17, 17)),
    features=4,
    trunk_width=16,
    carried=2,
    carried_size=(6, 8),
)
LABELS = make_label_set("test", ["a", "b", "c"])
POSES = [pose_at(-0.3), pose_at(-0.1, 0.1), pose_at(0.1), pose_at(0.3, -0.15)]
AWAY = pose_at(0.0, 3.14159)

COLOURS_ONLY = EncoderConfig(channels=(8, 16), blocks=(1, 1))
TINY_SRAY = SRayConfig(feature_dim=16, heads=2, encoder=SMALL_ENCODER)
TINY: dict[str, Config] = {
    "sray": TINY_SRAY,
    "sray-paper": msgspec.structs.replace(TINY_SRAY, tokens="samples", intra_view_attention=True),
    "unet": UNetFieldConfig(feature_dim=16, encoder=COLOURS_ONLY),
    "grid": GridFieldConfig(grid=TINY_IRT.grid),
    "irt": TINY_IRT,
    "irt-rttc": msgspec.structs.replace(TINY_IRT, variant="RTTC"),
    "panoptic": PanopticConfig(grid=TINY_IRT.grid, features=4, trunk_width=16),
}


def tiny(name: str, seed: int = 0, label_set: LabelSet = LABELS, config: Config | None = None) -> LearnedField:
    """Random weights, evaluation mode."""
    torch.manual_seed(seed)
    return build_field(name.split("-")[0], config or TINY[name], label_set).eval()


def assert_unknown(render: FieldRender) -> None:
    """Nothing known: zero logits, no opacity, full entropy."""
    assert not render.known.any()
    assert render.logits.abs().max() == 0 and render.opacity.abs().max() == 0
    assert render.rgb.abs().max() == 0 and render.depth_m.abs().max() == 0
    full = torch.log(torch.tensor(float(render.logits.shape[1])))
    torch.testing.assert_close(render.entropy, full.expand_as(render.entropy))


def assert_gradients_are_right(field: LearnedField, *, labelled: bool = False) -> None:
    """All parameters through encoding and rendering, every output, in double precision, against finite differences.
    ``labelled``: the first source view has known labels, stripes of all classes; the others have none."""
    field = field.double().train()
    full = wall_sources(POSES[:2])
    images = full.rgb[..., ::2, ::2].contiguous(), full.depth_m[:, ::2, ::2]
    cameras = full.K * torch.tensor([[0.5], [0.5], [1.0]]), full.T_world_camera
    views = SourceViews(*(t.double() for t in (*images, *cameras)))
    if labelled:
        channel = torch.full_like(views.depth_m, -1, dtype=torch.int64)
        channel[0] = torch.arange(channel.shape[2]) // 4 % len(LABELS)
        views = replace(views, channel=channel)
    rays = wall_rays(POSES[1], step=500)
    rays = RayBatch(*(t.double() for t in (rays.origin, rays.direction, rays.near_m, rays.far_m, rays.prior_depth_m)))
    z = sample_guided(rays, SamplingConfig(guided=3, free_space=0))

    def outputs(*_: torch.Tensor) -> tuple[torch.Tensor, ...]:
        encoded = field.encode(views)
        render = field.render_samples(rays, z, encoded)[0]
        assert render.known.all()
        own = field.source_logits(encoded)
        given = (render.logits, render.rgb, render.depth_m, render.entropy, own)
        return tuple(t for t in given if t is not None and t.requires_grad)  # PyTorch 2.11 mixes up the others

    parameters = tuple(field.parameters())
    assert torch.autograd.gradcheck(outputs, parameters, fast_mode=True, atol=1e-8, rtol=1e-3)
