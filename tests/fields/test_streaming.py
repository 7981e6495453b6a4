"""The compiled renderer against `SRay`, the readable reference, at the same weights and samples."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from semantic_mapper.config import EncoderConfig, SamplingConfig, SRayConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import Rendered, WorkingView
from semantic_mapper.fields.checkpoint import load_checkpoint, streamed, streaming
from semantic_mapper.fields.device import DeviceField
from semantic_mapper.fields.numbers import UNSURE_SPREAD
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.streaming import StreamedViews, StreamingSRay
from semantic_mapper.fields.volume import sample_guided, sample_inverse_depth
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import resize_depth, resize_rgb
from semantic_mapper.types import FieldRender, RayBatch, SourceViews
from tests.fields.scene import INTRINSICS, pose_at, streamed_rays, wall_rays, wall_sources, wall_view
from tests.fields.tiny_fields import LABELS, POSES
from tests.small import SMALL_ENCODER, tiny_frames

ONE_STAGE = EncoderConfig(channels=(8,), blocks=(1,), depth=True)
BEHIND = [pose_at(1.5), pose_at(0.0, 3.0)]  # a camera that sees part of the wall, and one that looks away from it
OUTPUTS = ("logits", "depth_m", "opacity", "rgb")


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
) -> tuple[Rendered, FieldRender]:
    with torch.inference_mode():
        encoded = field.encode(views)
        reference, _ = field.render_samples(rays, z, encoded, least)
    fast = streaming(field).render_samples(streamed_rays(rays), z.numpy(), streamed(encoded), least)
    return fast, reference


def assert_equal(fast: Rendered, reference: FieldRender, atol: float = 2e-5) -> None:
    np.testing.assert_array_equal(fast.known, reference.known)
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(fast, name), getattr(reference, name), atol=atol, rtol=2e-5, err_msg=name)


def encoded_wall(field: StreamingSRay, poses: Sequence[np.ndarray] = POSES) -> StreamedViews:
    """The wall from all poses, with random labels."""
    rng = np.random.default_rng(0)
    views = []
    for pose in poses:
        rgb, depth_m = (image.numpy() for image in wall_view(pose))
        rgb = np.ascontiguousarray((255 * rgb.transpose(1, 2, 0)).astype(np.uint8))
        views.append(field.encode(WorkingView(rgb, depth_m, INTRINSICS, pose, rng.integers(-1, 3, (32, 48)))))
    return field.stack(views)


BACKBONE = EncoderConfig(backbone="efficientnet-lite0", channels=(8, 8, 12), blocks=(1, 2, 0), depth=True)
FIELDS = {
    "surface": lambda: random_field(),
    "samples": lambda: random_field(tokens="samples"),
    "colours alone": lambda: random_field(encoder=msgspec.structs.replace(SMALL_ENCODER, depth=False)),
    "backbone": lambda: random_field(encoder=BACKBONE),
    "shipped": lambda: load_checkpoint(default_checkpoint_path()).model,
}


@pytest.mark.parametrize("name", FIELDS)
def test_it_encodes_what_the_reference_encodes(name: str):
    """To 5e-6 of the largest value: another order of sums, and batch norms that are part of the weights."""
    model, frame, rng = FIELDS[name](), tiny_frames(3)[2], np.random.default_rng(0)
    fast, reference = streaming(model), DeviceField(model, torch.device("cpu"), SamplingConfig())
    shown = set()
    for width, height in ((96, 72), (97, 71), (33, 24)):
        k = scale_intrinsics(frame.intrinsics, width, height)
        rgb, depth_m = resize_rgb(frame, k), resize_depth(frame, k)
        depth_m[height // 3 : height // 2, width // 3 : width // 2] = 0
        sigma_m = (depth_m * rng.uniform(0, 2 * UNSURE_SPREAD, depth_m.shape)).astype(np.float32)
        channel = rng.integers(-1, 3, depth_m.shape)
        for depth, spread in ((depth_m, None), (np.zeros_like(depth_m), None), (depth_m, sigma_m)):
            view = WorkingView(rgb, depth, k, frame.T_world_camera, channel, spread)
            found, wanted = fast.encode(view), streamed(reference.encode(view))
            for part, a, b in zip(found._fields, found, wanted, strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=5e-6 * max(1, np.abs(b).max()), err_msg=part)
            logits = reference.source_logits(reference.encode(view))
            np.testing.assert_allclose(fast.source_logits(found), logits, atol=1e-4 * np.abs(logits).max())
            shown.add(found.feature.tobytes())
    ways = 1 if not model.config.encoder.depth else 2 + model.config.encoder.computed_depth
    assert len(shown) == 3 * ways, "depth and its spread matter where the field has learned from them"


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
    found: dict[tuple[float, float], np.ndarray] = {}
    for factors in ((4.0, 4.0), (4.0, 1e3), (1.0, 1e3)):
        field.weigh_own_view(*factors)
        fast, reference = render_both(field, views, rays, z)
        assert_equal(fast, reference)
        found[factors] = fast.logits
    first = half.numpy()
    assert np.array_equal(found[4.0, 4.0][first], found[4.0, 1e3][first])
    assert np.array_equal(found[4.0, 1e3][~first], found[1.0, 1e3][~first])
    assert not np.array_equal(found[4.0, 4.0][~first], found[4.0, 1e3][~first])
    assert not np.array_equal(found[4.0, 1e3][first], found[1.0, 1e3][first])


@pytest.mark.parametrize("least", [0.02, 0.3, 0.5])
@pytest.mark.parametrize("heads", [1, 4])
def test_it_prunes_the_same_samples(least: float, heads: int):
    """With a fraction of 0.3 one sample of a ray is left, alone in its attention; with 0.5 none."""
    field = random_field(4, feature_dim=32, heads=heads)
    rays = wall_rays(pose_at(0.1), step=3)
    z = sample_guided(rays, SamplingConfig())
    with torch.inference_mode():
        encoded = field.encode(wall_sources(POSES))
        whole, weights = field.render_samples(rays, z, encoded)
        reference, _ = field.render_samples(rays, z, encoded, least)
    pruned = weights < least * weights.sum(1, keepdim=True)
    assert pruned.float().mean() > 0.1 and pruned.all() == (least == 0.5)
    # All of the ray's weight still says something, and geometry is what it was.
    assert torch.equal(reference.opacity, whole.opacity) and torch.equal(reference.depth_m, whole.depth_m)
    assert 1e-4 < (reference.logits - whole.logits).abs().max() < 20 * least
    fast = streaming(field).render_samples(streamed_rays(rays), z.numpy(), streamed(encoded), least)
    assert_equal(fast, reference)


@pytest.mark.parametrize("heads", [2, 4])
def test_a_broken_pixel_breaks_the_rays_that_look_at_it_and_no_others(heads: int):
    fast = streaming(random_field(feature_dim=32, heads=heads))
    encoded, rays = encoded_wall(fast), streamed_rays(wall_rays(pose_at(0.1), step=2))
    whole = fast.render(rays, encoded).logits
    for value in (float("nan"), float("inf")):
        feature = encoded.feature.copy()
        feature[2, 8, 12, 5] = value
        logits = fast.render(rays, encoded._replace(feature=feature)).logits
        broken = ~np.isfinite(logits).all(1)
        assert 0 < broken.sum() < 0.2 * len(broken)
        assert np.array_equal(logits[~broken], whole[~broken])


def test_the_same_bits_in_every_run_and_on_any_number_of_threads():
    fast = streaming(random_field(feature_dim=32, heads=4))
    encoded = encoded_wall(fast)
    rays = streamed_rays(wall_rays(pose_at(0.1), step=3))
    renders: list[Rendered] = []
    for threads in (1, 1, 2, 5):
        torch.set_num_threads(threads)
        renders.append(fast.render(rays, encoded))
    for render in renders[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(render, renders[0], strict=True))


def test_maps_that_do_not_fit_are_refused():
    fast, rays = streaming(random_field()), streamed_rays(wall_rays(pose_at(0.1), step=5))
    encoded = encoded_wall(fast)
    for name in ("rgb", "geometry", "log_scale", "K", "T_camera_world", "channel"):
        with pytest.raises(ShapeError, match=f"source {name}"):
            fast.render(rays, encoded._replace(**{name: getattr(encoded, name)[:3]}))
    with pytest.raises(ShapeError, match="source feature"):
        fast.render(rays, encoded._replace(feature=encoded.feature[..., :12]))
    z = np.random.default_rng(0).random((len(rays.origin), 4), np.float32)
    with pytest.raises(ShapeError, match="ray directions"):
        fast.render_samples(replace(rays, direction=rays.direction[:5]), z, encoded)
    with pytest.raises(ShapeError, match="at least 2 samples"):
        fast.render_samples(rays, z[:, :1], encoded)
    for count in (0, 17):
        with pytest.raises(ShapeError, match="1 to 16"):
            fast.stack([encoded_wall(fast, POSES[:1])] * count)
    view = WorkingView(np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8), np.float32), INTRINSICS, np.eye(4))
    with pytest.raises(ShapeError, match="share one resolution"):
        fast.stack([fast.encode(view), encoded_wall(fast, POSES[:1])])
    for name in ("depth_m", "channel", "depth_sigma_m"):
        with pytest.raises(ShapeError, match=f"source {name}"):
            fast.encode(replace(view, **{name: np.zeros((8, 9), np.float32)}))


def test_labels_of_images_of_odd_and_even_sizes_go_together():
    fast = streaming(random_field())
    even = encoded_wall(fast, POSES[:1])
    rgb, depth_m = np.zeros((31, 47, 3), np.uint8), np.ones((31, 47), np.float32)
    bare = WorkingView(rgb, depth_m, INTRINSICS, POSES[1])
    odd = fast.encode(replace(bare, channel=np.arange(31 * 47).reshape(31, 47) % 3))
    channel = fast.stack([even, odd, fast.encode(bare)]).channel
    np.testing.assert_array_equal(channel[0], even.channel[0])
    assert (channel[1, :31, :47] == odd.channel[0]).mean() > 0.3 and (channel[2] == -1).all()
