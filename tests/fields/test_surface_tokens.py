"""One token a view, at the surface: a vote of the views to start from, and an opinion of what has no surface."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from semantic_mapper.config import SRayConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.contextual import contextual_space, surface_space
from semantic_mapper.fields.sampling import sample_inverse_depth
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.sray_streaming import StreamingSRay
from semantic_mapper.fields.volume import compositing_weights
from semantic_mapper.labels import make_label_set
from semantic_mapper.types import RayBatch
from tests.fields.scene import WALL_M, pose_at, wall_rays, wall_sources
from tests.small import SMALL_ENCODER

LABELS = make_label_set("test", ["a", "b", "c"])
POSES = [pose_at(-0.3), pose_at(-0.1, 0.1), pose_at(0.1), pose_at(0.3, -0.15)]


def small_field(**changes: object) -> SRay:
    torch.manual_seed(0)
    config = {"feature_dim": 16, "heads": 2, "encoder": SMALL_ENCODER} | changes
    return SRay(SRayConfig(**config), LABELS).eval()  # pyright: ignore[reportArgumentType]


def constant_features(encoded: EncodedViews, values: list[float]) -> EncodedViews:
    """Each view with one feature vector everywhere: a random one times its value."""
    one = torch.randn(encoded.feature.shape[1], generator=torch.Generator().manual_seed(1))
    feature = torch.tensor(values)[:, None, None, None] * one[None, :, None, None]
    return replace(encoded, feature=feature.expand_as(encoded.feature).contiguous())


def on_wall(rays: RayBatch) -> torch.Tensor:
    return torch.tensor([0.97, 0.99, 1.01, 1.03])[None].expand(len(rays.origin), 4) * WALL_M


def test_untrained_it_is_the_mean_of_what_its_views_say():
    """Weighted by how much each view sees of the surface, which is alike here."""
    field = small_field()
    encoded = constant_features(field.encode(wall_sources(POSES[:3])), [1.0, -2.0, 0.5])
    rays = wall_rays(pose_at(0.0), step=31)
    z = on_wall(rays)
    render, _ = field.render_samples(rays, z, encoded)
    said = field.source_logits(encoded)
    assert said is not None
    space = contextual_space(rays, z, encoded)
    seen = space.valid.all(2).all(0)
    assert seen.sum() > 10
    sigma = field.find_density(space)
    token = surface_space(space, compositing_weights(sigma, space.delta), rays, encoded, occlusion=True)
    share = token.visibility[..., 0] / token.visibility[..., 0].sum(0)
    assert (share[:, seen] - 1 / 3).abs().max() < 0.02
    mean = torch.einsum("mr,ml->rl", share, said[:, :, 0, 0])
    torch.testing.assert_close(render.logits[seen], mean[seen], atol=1e-4, rtol=1e-3)


def test_the_paper_s_order_is_not_a_vote():
    field = small_field(tokens="samples")
    encoded = constant_features(field.encode(wall_sources(POSES[:3])), [1.0, -2.0, 0.5])
    rays = wall_rays(pose_at(0.0), step=31)
    render, _ = field.render_samples(rays, on_wall(rays), encoded)
    said = field.source_logits(encoded)
    assert said is not None
    assert (render.logits[render.known] - said[:, :, 0, 0].mean(0)).abs().max() > 0.05


@pytest.mark.parametrize("streaming", [False, True])
def test_a_ray_that_meets_nothing_takes_what_the_views_say_of_its_direction(streaming: bool):
    """The sky: no surface within reach, but every view that looks that way has an opinion of it."""
    field = small_field()
    views = wall_sources(POSES)
    encoded = constant_features(field.encode(views), [1.0] * len(POSES))
    away = torch.full_like(encoded.geometry[:, 0], 50.0)  # the views' own rays end far behind all samples
    geometry = torch.stack((away, away * 0.01, away, away * 0.01, torch.ones_like(away)), dim=1)
    encoded = replace(encoded, geometry=geometry)
    rays = wall_rays(pose_at(0.0), step=31)
    z = sample_inverse_depth(rays.near_m, rays.far_m, 16)
    render = StreamingSRay(field).render_samples(rays, z, encoded) if streaming else None
    with torch.no_grad():
        render = render or field.render_samples(rays, z, encoded)[0]
        said = field.source_logits(encoded)
    assert said is not None
    seen = render.known & (render.opacity < 0.1)
    assert seen.float().mean() > 0.5
    torch.testing.assert_close(render.logits[seen], said[0, :, 0, 0].expand(int(seen.sum()), 3), atol=1e-3, rtol=1e-3)


def test_the_token_of_the_query_s_own_view_says_so():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(POSES[2], step=31)
    z = on_wall(rays)
    space = contextual_space(rays, z, encoded)
    sigma = field.find_density(space)
    tokens = surface_space(space, compositing_weights(sigma, space.delta), rays, encoded, occlusion=True)
    assert tokens.feature.shape[2] == 1
    assert tokens.cues[2, ..., -1].min() == 1 and tokens.cues[[0, 1, 3], ..., -1].max() == 0


def test_the_factor_of_the_own_view_leads_from_the_vote_to_the_own_image_alone():
    field = small_field()
    encoded = constant_features(field.encode(wall_sources(POSES[:3])), [1.0, -2.0, 0.5])
    rays = wall_rays(POSES[1], step=31)
    said = field.source_logits(encoded)
    assert said is not None
    others, own = said[[0, 2], :, 5, 5].mean(0), said[1, :, 5, 5]
    space = contextual_space(rays, on_wall(rays), encoded)
    seen = space.valid.all(2).all(0)
    assert seen.sum() > 10
    weights = compositing_weights(field.find_density(space), space.delta)
    visibility = surface_space(space, weights, rays, encoded, occlusion=True).visibility[:, seen, 0]
    for factor in (1.0, 4.0, 1e6):
        field.own_view_factor.fill_(factor)
        logits = field.render_samples(rays, on_wall(rays), encoded)[0].logits[seen]
        share = factor * visibility[1] / (visibility[0] + factor * visibility[1] + visibility[2])
        wanted = share[:, None] * own + (1 - share[:, None]) * others
        # The other two do not see the wall quite alike, and are said to here.
        assert (logits - wanted).abs().max() < (1e-4 if factor > 1e5 else 0.05) * (others - own).abs().max()


def test_a_file_keeps_the_factors_of_the_own_view_and_an_old_one_has_one_or_none(tmp_path: Path):
    field = small_field()
    field.weigh_own_view(4.0, 16.0)
    path = tmp_path / "new.safetensors"
    save_checkpoint(Checkpoint(field), path, half=True)
    new = load_checkpoint(path).model
    assert isinstance(new, SRay) and new.own_view_factor.tolist() == [4, 16]
    with safe_open(path, framework="pt") as stored:
        metadata = dict(stored.metadata() or {})
    tensors = load_file(path)
    name = next(name for name in tensors if "own_view_factor" in name)
    others = {n: t for n, t in tensors.items() if n != name}
    for stored, factors in (({name: torch.tensor(4.0)}, [4, 4]), ({}, [1, 1])):
        save_file(others | stored, path, metadata)
        old = load_checkpoint(path).model
        assert isinstance(old, SRay) and old.own_view_factor.tolist() == factors


def test_a_view_whose_sight_is_blocked_has_no_token():
    field = small_field()
    views = wall_sources(POSES)
    depth_m = views.depth_m.clone()
    depth_m[3] = 0.5 * WALL_M
    encoded = field.encode(replace(views, depth_m=depth_m))
    rays = wall_rays(pose_at(0.0), step=31)
    loud = replace(encoded, feature=encoded.feature * torch.tensor([1.0, 1, 1, 100])[:, None, None, None])
    quiet = replace(encoded, feature=encoded.feature * torch.tensor([1.0, 1, 1, -100])[:, None, None, None])
    seen = contextual_space(rays, on_wall(rays), encoded).valid.all(2)[:3].any(0)
    with torch.no_grad():
        # The density sees all features; so it is the wall's in both.
        a = field.render_samples(rays, on_wall(rays), loud)[0].logits[seen]
        b = field.render_samples(rays, on_wall(rays), quiet)[0].logits[seen]
    assert (a.argmax(1) == b.argmax(1)).float().mean() > 0.95


def test_everything_that_is_learned_gets_a_gradient_once_training_has_begun():
    field = small_field(intra_view_attention=True).train()
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.05), step=31)
    render, _ = field.render_samples(rays, on_wall(rays), encoded)
    (render.logits.square().sum() + render.rgb.sum() + render.depth_m.sum()).backward()
    idle = [n for n, p in field.named_parameters() if "colour_net" not in n and (p.grad is None or not p.grad.any())]
    assert idle == ["label_logit"]  # these views have no known labels


def test_a_file_from_before_this_setting_is_of_the_paper_s_form(tmp_path: Path):
    field = small_field(tokens="samples", intra_view_attention=True)
    path = tmp_path / "old.safetensors"
    save_checkpoint(Checkpoint(field), path)
    old = _without_setting(path, "tokens")
    loaded = load_checkpoint(old).model
    assert loaded.config == field.config
    rays = wall_rays(pose_at(0.0), step=31)
    with torch.no_grad():
        a = field.render(rays, field.encode(wall_sources(POSES))).logits
        b = loaded.render(rays, loaded.encode(wall_sources(POSES))).logits
    assert torch.equal(a, b)


def test_density_depends_on_how_much_the_colours_of_the_views_differ():
    """At a sample where features, depth and visibility say the same."""
    for moments in (True, False):
        field = small_field(colour_moments=moments)
        encoded = field.encode(wall_sources(POSES))
        tint = torch.tensor([0.4, -0.4, 0.4, -0.4])[:, None, None, None]
        rays = wall_rays(pose_at(0.0), step=31)
        alike = contextual_space(rays, on_wall(rays), replace(encoded, rgb=torch.full_like(encoded.rgb, 0.5)))
        differing = contextual_space(rays, on_wall(rays), replace(encoded, rgb=(0.5 + tint).expand_as(encoded.rgb)))
        with torch.no_grad():
            changed = (field.find_density(alike) - field.find_density(differing)).abs().amax()
        assert (changed > 1e-3) == moments


def test_a_file_from_before_colour_moments_has_none(tmp_path: Path):
    field = small_field(colour_moments=False)
    path = tmp_path / "old.safetensors"
    save_checkpoint(Checkpoint(field), path)
    assert load_checkpoint(_without_setting(path, "colour_moments")).model.config == field.config


def _without_setting(path: Path, name: str) -> Path:
    with safe_open(path, framework="pt") as stored:
        metadata = dict(stored.metadata() or {})
    config = json.loads(metadata["model_config"])
    del config[name]
    target = path.with_name("older.safetensors")
    save_file(load_file(path), target, metadata | {"model_config": json.dumps(config)})
    return target


def test_the_published_code_s_departures_need_the_paper_s_form():
    with pytest.raises(ConfigError, match="published"):
        small_field(parity="published", tokens="surface")


@pytest.mark.parametrize("streaming", [False, True])
def test_where_no_view_knows_the_depth_the_query_s_own_view_decides(streaming: bool):
    """The upper half of a street: no scanner reaches it, so what the views believe of its depth is a guess."""
    field = small_field()
    encoded = constant_features(field.encode(wall_sources(POSES)), [1.0, -2.0, 3.0, 0.5])
    near = torch.full_like(encoded.geometry[:, 0], 0.2 * WALL_M)  # all samples are hidden from all views
    geometry = torch.stack((near, near * 0.02, near, near * 0.02, torch.ones_like(near)), dim=1)
    encoded = replace(encoded, geometry=geometry)
    rays = wall_rays(POSES[2], step=31)
    with torch.no_grad():
        render = (
            StreamingSRay(field).render_samples(rays, on_wall(rays), encoded)
            if streaming
            else field.render_samples(rays, on_wall(rays), encoded)[0]
        )
        said = field.source_logits(encoded)
    assert said is not None
    torch.testing.assert_close(render.logits, said[2, :, 0, 0].expand_as(render.logits), atol=1e-2, rtol=1e-2)
