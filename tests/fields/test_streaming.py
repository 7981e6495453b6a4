"""The compiled renderer against `SRay`, the readable reference, at the same weights and samples."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch

from semantic_mapper.config import EncoderConfig, SamplingConfig, SRayConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.checkpoint import streaming
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.volume import sample_guided, sample_inverse_depth
from semantic_mapper.types import FieldRender, RayBatch, SourceViews
from tests.fields.scene import pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import LABELS, POSES

ONE_STAGE = EncoderConfig(channels=(8,), blocks=(1,), depth=True)
BEHIND = [pose_at(1.5), pose_at(0.0, 3.0)]  # a camera that sees part of the wall, and one that looks away from it
OUTPUTS = ("logits", "depth_m", "opacity", "rgb", "entropy")


@pytest.fixture(autouse=True)
def _keep_thread_count() -> Iterator[None]:
    count = torch.get_num_threads()
    yield
    torch.set_num_threads(count)


def random_field(seed: int = 3, **changes: Any) -> SRay:
    """Weights that make all parts of the network count."""
    torch.manual_seed(seed)
    shape = {"feature_dim": 16, "heads": 2, "encoder": ONE_STAGE}
    field = SRay(SRayConfig(**{**shape, **changes}), LABELS).eval()
    for p in field.parameters():
        p.data += 0.05 * torch.randn_like(p)
    return field


def labelled(views: SourceViews) -> SourceViews:
    return replace(views, channel=torch.randint(-1, 3, views.depth_m.shape))


def render_both(
    field: SRay, views: SourceViews, rays: RayBatch, z: torch.Tensor, least: float = 0.0
) -> tuple[FieldRender, FieldRender]:
    streaming = streaming(field)
    encoded = streaming.encode(views)
    with torch.inference_mode():
        reference, _ = field.render_samples(rays, z, encoded, least)
    return streaming.render_samples(rays, z, encoded, least), reference


def assert_equal(fast: FieldRender, reference: FieldRender, atol: float = 2e-5) -> None:
    assert torch.equal(fast.known, reference.known)
    for name in OUTPUTS:
        torch.testing.assert_close(getattr(fast, name), getattr(reference, name), atol=atol, rtol=2e-5, msg=name)


@pytest.mark.parametrize(("intra", "cross"), [(True, True), (False, True), (True, False), (False, False)])
@pytest.mark.parametrize("tokens", ["surface", "samples"])
@pytest.mark.parametrize("guided", [True, False])
def test_it_renders_what_the_reference_renders(intra: bool, cross: bool, guided: bool, tokens: str):
    rays = wall_rays(pose_at(0.2, 0.3), step=3)
    z = sample_guided(rays, SamplingConfig()) if guided else sample_inverse_depth(rays.near_m, rays.far_m, 24)
    field = random_field(tokens=tokens, intra_view_attention=intra, cross_view_attention=cross)
    assert_equal(*render_both(field, labelled(wall_sources([*POSES, *BEHIND])), rays, z))


@pytest.mark.parametrize("filled", [True, False])
def test_the_own_view_counts_otherwise_on_rays_without_measured_depth(filled: bool):
    field = random_field()
    views = labelled(wall_sources([*POSES, *BEHIND]))
    rays = wall_rays(POSES[1], step=3)
    z = sample_guided(rays, SamplingConfig())
    half = torch.arange(len(z)) < len(z) // 2
    rays = replace(rays, measured=half) if filled else replace(rays, prior_depth_m=rays.prior_depth_m * half)
    found: dict[tuple[float, float], torch.Tensor] = {}
    for factors in ((4.0, 4.0), (4.0, 1e3), (1.0, 1e3)):
        field.weigh_own_view(*factors)
        fast, reference = render_both(field, views, rays, z)
        assert_equal(fast, reference)
        found[factors] = fast.logits
    assert torch.equal(found[4.0, 4.0][half], found[4.0, 1e3][half])
    assert torch.equal(found[4.0, 1e3][~half], found[1.0, 1e3][~half])
    assert not torch.equal(found[4.0, 4.0][~half], found[4.0, 1e3][~half])
    assert not torch.equal(found[4.0, 1e3][half], found[1.0, 1e3][half])


@pytest.mark.parametrize("least", [0.02, 0.3, 0.5])
@pytest.mark.parametrize("heads", [1, 4])
def test_it_prunes_the_same_samples(least: float, heads: int):
    """With a fraction of 0.3 one sample of a ray is left, alone in its attention; with 0.5 none."""
    field = random_field(4, feature_dim=32, heads=heads)
    rays = wall_rays(pose_at(0.1), step=3)
    z = sample_guided(rays, SamplingConfig())
    encoded = field.encode(wall_sources(POSES))
    with torch.inference_mode():
        whole, weights = field.render_samples(rays, z, encoded)
        reference, _ = field.render_samples(rays, z, encoded, least)
    pruned = weights < least * weights.sum(1, keepdim=True)
    assert pruned.float().mean() > 0.1 and pruned.all() == (least == 0.5)
    # All of the ray's weight still says something, and geometry is what it was.
    assert torch.equal(reference.opacity, whole.opacity) and torch.equal(reference.depth_m, whole.depth_m)
    assert 1e-4 < (reference.logits - whole.logits).abs().max() < 20 * least
    assert_equal(streaming(field).render_samples(rays, z, encoded, least), reference)


@pytest.mark.parametrize("heads", [2, 4])
def test_a_broken_pixel_breaks_the_rays_that_look_at_it_and_no_others(heads: int):
    streaming = streaming(random_field(feature_dim=32, heads=heads))
    encoded, rays = streaming.encode(wall_sources(POSES)), wall_rays(pose_at(0.1), step=2)
    whole = streaming.render(rays, encoded).logits
    for value in (float("nan"), float("inf")):
        feature = encoded.feature.clone()
        feature[2, 5, 8, 12] = value
        logits = streaming.render(rays, replace(encoded, feature=feature)).logits
        broken = ~torch.isfinite(logits).all(1)
        assert 0 < broken.sum() < 0.2 * len(broken)
        assert torch.equal(logits[~broken], whole[~broken])


def test_the_same_bits_in_every_run_and_on_any_number_of_threads():
    streaming = streaming(random_field(feature_dim=32, heads=4))
    encoded = streaming.encode(labelled(wall_sources(POSES)))
    rays = wall_rays(pose_at(0.1), step=3)
    renders: list[FieldRender] = []
    for threads in (1, 1, 2, 5):
        torch.set_num_threads(threads)
        renders.append(streaming.render(rays, encoded))
    for render in renders[1:]:
        assert all(torch.equal(getattr(render, name), getattr(renders[0], name)) for name in (*OUTPUTS, "known"))


def test_maps_that_do_not_fit_are_refused():
    streaming, rays = streaming(random_field()), wall_rays(pose_at(0.1), step=5)
    encoded = streaming.encode(labelled(wall_sources(POSES)))
    for name in ("rgb", "geometry", "K", "T_camera_world", "channel"):
        with pytest.raises(ShapeError, match=f"source {name}"):
            streaming.render(rays, replace(encoded, **{name: getattr(encoded, name)[:3]}))
    with pytest.raises(ShapeError, match="source feature"):
        streaming.render(rays, replace(encoded, feature=encoded.feature[:, :12]))
    with pytest.raises(ShapeError, match="ray directions"):
        streaming.render_samples(replace(rays, direction=rays.direction[:5]), torch.rand(len(rays.origin), 4), encoded)
    with pytest.raises(ShapeError, match="at least 2 samples"):
        streaming.render_samples(rays, rays.prior_depth_m[:, None], encoded)
