"""S-Ray's equations on a wall that many cameras see, in the paper's order and with one token a view at the surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import Rendered
from semantic_mapper.fields.checkpoint import streamed, streaming
from semantic_mapper.fields.sray import SRay, contextual_space, hit_and_visibility, surface_space
from semantic_mapper.fields.views import EncodedViews, gather, reproject, stack_views
from semantic_mapper.fields.volume import compositing_weights, sample_inverse_depth
from semantic_mapper.types import FieldRender, RayBatch, SourceViews
from tests.fields.scene import WALL_M, pose_at, streamed_rays, wall_colour, wall_rays, wall_sources
from tests.fields.tiny_fields import POSES, assert_gradients_are_right, tiny


def small_field() -> SRay:
    field = tiny("sray")
    assert isinstance(field, SRay)
    return field


def test_reprojection_finds_the_same_wall_point_in_every_view():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.05, 0.02), step=7)
    true_z = (WALL_M - rays.origin[:, 2]) / rays.direction[:, 2]
    z = torch.stack((true_z, true_z + 0.5), 1)
    where = reproject(rays, z, encoded)
    found, uv = gather(encoded, where), where.uv[:, :, 0]
    seen = where.valid[..., 0] & ((uv > 0) & (uv < torch.tensor([23.0, 15.0]))).all(-1)
    points = rays.origin + true_z[:, None] * rays.direction
    expected = wall_colour(points[:, 0], points[:, 1]).expand(len(POSES), -1, -1)
    error = (found.rgb[:, :, 0] - expected).abs().amax(-1)[seen]
    assert seen.float().mean() > 0.5
    assert error.max() < 0.05  # half-resolution colours of a smooth texture
    wrong = (found.rgb[:, :, 1] - expected).abs().amax(-1)[seen]
    assert wrong.mean() > 3 * error.mean()


def test_measured_depth_makes_the_wall_hit_and_what_is_behind_it_invisible():
    field = small_field()
    encoded = field.encode(wall_sources([pose_at(0.0)]))
    rays = wall_rays(pose_at(0.0), step=97)
    z = torch.tensor([[1.5, WALL_M, 2.5]]).expand(len(rays.origin), 3)
    found = gather(encoded, reproject(rays, z, encoded))
    hit, visibility = hit_and_visibility(found.geometry, z[None], torch.tensor(0.05))
    assert (hit[..., 1] > 0.5).all() and (hit[..., 0] < 0.05).all()
    assert (visibility[..., 0] > 0.9).all() and (visibility[..., 2] < 0.1).all()


def test_a_ray_that_no_view_sees_is_unknown():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    away = field.render(wall_rays(pose_at(0.0, 3.14159), step=53), encoded)
    assert not away.known.any() and not away.logits.any() and not away.opacity.any()


def test_a_view_is_left_out_where_the_sample_is_hidden_from_it_and_not_from_others():
    field = small_field()
    views = wall_sources(POSES)
    depth_m = views.depth_m.clone()
    depth_m[3] = 0.5 * WALL_M  # something stands before this camera
    encoded = field.encode(replace(views, depth_m=depth_m))
    rays = wall_rays(pose_at(0.0), step=31)
    z = torch.tensor([[0.98 * WALL_M, 1.01 * WALL_M, 1.3 * WALL_M]]).expand(len(rays.origin), 3)
    space = contextual_space(rays, z, encoded)
    seen = field.mask_occluded(space).valid
    inside = space.valid.all(0)
    assert inside.float().mean() > 0.5
    on_wall, behind = inside[:, :2], inside[:, 2]
    assert seen[:3, :, :2][:, on_wall].all() and not seen[3, :, :2][on_wall].any()
    assert seen[:, :, 2][:, behind].all()  # hidden from all: any view is better than none


def test_world_frame_does_not_matter():
    field = small_field()
    views = wall_sources(POSES)
    rays = wall_rays(pose_at(0.0), step=31)
    T = torch.from_numpy(pose_at(1.7, 0.8)).float()
    T[1, 3] = -0.4
    moved_views = SourceViews(views.rgb, views.depth_m, views.K, T @ views.T_world_camera)
    moved_rays = RayBatch(
        rays.origin @ T[:3, :3].T + T[:3, 3], rays.direction @ T[:3, :3].T, rays.near_m, rays.far_m, rays.prior_depth_m
    )
    a = field.render(rays, field.encode(views)).logits
    b = field.render(moved_rays, field.encode(moved_views)).logits
    torch.testing.assert_close(a, b, atol=2e-3, rtol=2e-3)


def test_the_whole_field_passes_gradcheck_with_labels_that_a_source_view_brings():
    field = small_field()
    encoded = labelled_wall(field, torch.full((1, 32, 48), 2), pose_at(0.0))
    field.render(wall_rays(pose_at(0.1), step=101), encoded).logits[:, 2].sum().backward()
    assert field.label_logit.grad is not None and field.label_logit.grad > 1, "labels reach the logits"
    assert_gradients_are_right(tiny("sray"), labelled=True)


def labelled_wall(field: SRay, channel: torch.Tensor, *poses: np.ndarray) -> EncodedViews:
    return field.encode(replace(wall_sources(list(poses)), channel=channel))


def test_labels_of_a_source_view_are_carried_to_where_they_belong():
    """The right half of a view's wall is of class 2: from any pose, and from class 2 alone, the ray's x tells."""
    field = small_field()
    channel = torch.full((1, 32, 48), 1)
    channel[:, :, 24:] = 2
    encoded = labelled_wall(field, channel, pose_at(0.0))
    for pose in (pose_at(0.0), pose_at(0.3, 0.1)):
        rays = wall_rays(pose)
        render = field.render(rays, encoded)
        x = (rays.origin + (WALL_M / rays.direction[:, 2:]) * rays.direction)[:, 0]
        clear = render.known & (x.abs() > 0.08)  # but for the pixels that the border runs through
        assert (render.logits.argmax(1)[clear] == torch.where(x > 0, 2, 1)[clear]).all() and clear.sum() > 500


def test_a_view_carries_no_label_to_what_is_hidden_from_it():
    """Seen from (3, 0) the wall stands at 2 m; a surface 0.5 m behind it takes nothing over."""
    field = small_field()
    encoded = labelled_wall(field, torch.full((1, 32, 48), 2), pose_at(0.0))
    rays = wall_rays(pose_at(0.0), step=7)

    def carried(z: float) -> torch.Tensor:
        ladder = (z + torch.tensor([-0.02, 0.0, 0.02])).expand(len(rays.origin), 3)
        return field.propagate_labels(contextual_space(rays, ladder, encoded))[:, 1, 2]

    assert carried(WALL_M).min() > 0.6 and carried(WALL_M + 0.5).max() < 0.15 and carried(WALL_M - 0.5).max() < 0.15


def test_views_that_do_not_fit_are_refused():
    field, views = small_field(), wall_sources(POSES)
    with pytest.raises(ShapeError, match="source depth_m"):
        field.encode(SourceViews(views.rgb, views.depth_m[:2], views.K, views.T_world_camera))
    with pytest.raises(ShapeError, match="source channel"):
        field.encode(replace(views, channel=torch.zeros(4, 16, 24, dtype=torch.int64)))
    with pytest.raises(ShapeError, match="1 to 16"):
        stack_views([field.encode(wall_sources(POSES[:1]))] * 17)


def constant_features(encoded: EncodedViews, values: list[float]) -> EncodedViews:
    """Each view with one feature vector everywhere: a random one times its value."""
    one = torch.randn(encoded.feature.shape[1], generator=torch.Generator().manual_seed(1))
    feature = torch.tensor(values)[:, None, None, None] * one[None, :, None, None]
    return replace(encoded, feature=feature.expand_as(encoded.feature).contiguous())


def ending_at(encoded: EncodedViews, z: float) -> EncodedViews:
    """Views whose rays all end at this depth, almost for sure."""
    end = torch.full_like(encoded.geometry[:, 0], z)
    return replace(encoded, geometry=torch.stack((end, end * 0.01, end, end * 0.01, torch.ones_like(end)), dim=1))


def rendered(
    field: SRay, rays: RayBatch, z: torch.Tensor, encoded: EncodedViews, compiled: bool
) -> tuple[FieldRender | Rendered, torch.Tensor]:
    """By the field or by its compiled renderer; and what the views say by themselves."""
    with torch.no_grad():
        said = field.source_logits(encoded)
        if not compiled:
            return field.render_samples(rays, z, encoded)[0], said
    found = streaming(field).render_samples(streamed_rays(rays), z.numpy(), streamed(encoded))
    return Rendered(*map(torch.from_numpy, found)), said


def on_wall(rays: RayBatch) -> torch.Tensor:
    return torch.tensor([0.97, 0.99, 1.01, 1.03])[None].expand(len(rays.origin), 4) * WALL_M


@pytest.mark.parametrize("compiled", [False, True])
def test_a_ray_that_meets_nothing_takes_what_the_views_say_of_its_direction(compiled: bool):
    """The sky: no surface within reach, but every view that looks that way has an opinion of it."""
    field = small_field()
    views = wall_sources(POSES)
    encoded = constant_features(field.encode(views), [1.0] * len(POSES))
    encoded = ending_at(encoded, 50.0)  # the views' own rays end far behind all samples
    rays = wall_rays(pose_at(0.0), step=31)
    z = sample_inverse_depth(rays.near_m, rays.far_m, 16)
    render, said = rendered(field, rays, z, encoded, compiled)
    seen = render.known & (render.opacity < 0.1)
    assert seen.float().mean() > 0.5
    torch.testing.assert_close(render.logits[seen], said[0, :, 0, 0].expand(int(seen.sum()), 3), atol=1e-3, rtol=1e-3)


def test_the_factor_of_the_own_view_leads_from_the_vote_to_the_own_image_alone():
    field = small_field()
    encoded = constant_features(field.encode(wall_sources(POSES[:3])), [1.0, -2.0, 0.5])
    rays = wall_rays(POSES[1], step=31)
    said = field.source_logits(encoded)
    others, own = said[[0, 2], :, 5, 5].mean(0), said[1, :, 5, 5]
    space = contextual_space(rays, on_wall(rays), encoded)
    seen = space.valid.all(2).all(0)
    assert seen.sum() > 10
    weights = compositing_weights(field.find_density(space), space.delta)
    visibility = surface_space(space, weights, rays, encoded).visibility[:, seen, 0]
    for factor in (1.0, 4.0, 1e6):
        field.own_view_factor.fill_(factor)
        logits = field.render_samples(rays, on_wall(rays), encoded)[0].logits[seen]
        fraction = factor * visibility[1] / (visibility[0] + factor * visibility[1] + visibility[2])
        wanted = fraction[:, None] * own + (1 - fraction[:, None]) * others
        # The other two do not see the wall quite alike, and are said to here.
        assert (logits - wanted).abs().max() < (1e-4 if factor > 1e5 else 0.05) * (others - own).abs().max()


@pytest.mark.parametrize("compiled", [False, True])
def test_where_no_view_knows_the_depth_the_query_s_own_view_decides(compiled: bool):
    """The upper half of a street: no scanner reaches it, so what the views believe of its depth is a guess."""
    field = small_field()
    encoded = constant_features(field.encode(wall_sources(POSES)), [1.0, -2.0, 3.0, 0.5])
    encoded = ending_at(encoded, 0.2 * WALL_M)  # all samples are hidden from all views
    rays = wall_rays(POSES[2], step=31)
    render, said = rendered(field, rays, on_wall(rays), encoded, compiled)
    torch.testing.assert_close(render.logits, said[2, :, 0, 0].expand_as(render.logits), atol=1e-2, rtol=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sray", "sray-paper"])
def test_the_whole_field_passes_gradcheck(name: str):
    assert_gradients_are_right(tiny(name))
