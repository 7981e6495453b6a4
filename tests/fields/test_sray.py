from dataclasses import replace

import numpy as np
import pytest
import torch

from semantic_mapper.config import EncoderConfig, SamplingConfig, SRayConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import EncodedViews, stack_views
from semantic_mapper.fields.contextual import contextual_space
from semantic_mapper.fields.geometry_net import hit_and_visibility
from semantic_mapper.fields.projection import gather, reproject
from semantic_mapper.fields.sampling import sample_guided
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import ROOMS, make_label_set
from semantic_mapper.types import RayBatch, SourceViews
from tests.fields.scene import WALL_M, pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import assert_gradients_are_right, tiny
from tests.small import SMALL_ENCODER

LABELS = make_label_set("test", ["a", "b", "c"])
ONE_STAGE = EncoderConfig(channels=(8,), blocks=(1,), depth=True)
SMALL = SRayConfig(feature_dim=16, heads=2, encoder=SMALL_ENCODER)
POSES = [pose_at(-0.3), pose_at(-0.1, 0.1), pose_at(0.1), pose_at(0.3, -0.15)]


def small_field(seed: int = 0, **changes: object) -> SRay:
    torch.manual_seed(seed)
    return SRay(SRayConfig(**{**{f: getattr(SMALL, f) for f in SMALL.__struct_fields__}, **changes}), LABELS).eval()


def test_reprojection_finds_the_same_wall_point_in_every_view():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.05, 0.02), step=7)
    z = torch.full((len(rays.origin), 2), 0.0)
    true_z = (WALL_M - rays.origin[:, 2]) / rays.direction[:, 2]
    z[:, 0], z[:, 1] = true_z, true_z + 0.5
    where = reproject(rays, z, encoded)
    found = gather(encoded, where)
    seen = where.valid[..., 0] & (where.uv[..., 0, 0] > 0) & (where.uv[..., 0, 0] < 23) & (where.uv[..., 0, 1] > 0)
    seen &= where.uv[..., 0, 1] < 15
    points = rays.origin + true_z[:, None] * rays.direction
    from tests.fields.scene import wall_colour

    expected = wall_colour(points[:, 0], points[:, 1]).expand(len(POSES), -1, -1)
    error = (found.rgb[:, :, 0] - expected).abs().amax(-1)[seen]
    assert seen.float().mean() > 0.5
    assert error.max() < 0.05  # half-resolution colours of a smooth texture
    wrong = (found.rgb[:, :, 1] - expected).abs().amax(-1)[seen]
    assert wrong.mean() > 3 * error.mean()


def test_samples_behind_a_camera_or_outside_its_image_are_invalid():
    encoded = small_field().encode(wall_sources([pose_at(0.0), pose_at(0.0, 3.14159)]))
    where = reproject(wall_rays(pose_at(0.0), step=50), torch.full((31, 1), 2.0), encoded)
    assert where.valid[0].all()
    assert not where.valid[1].any()


def test_measured_depth_makes_the_wall_hit_and_what_is_behind_it_invisible():
    field = small_field()
    encoded = field.encode(wall_sources([pose_at(0.0)]))
    rays = wall_rays(pose_at(0.0), step=97)
    z = torch.tensor([[1.5, WALL_M, 2.5]]).expand(len(rays.origin), 3)
    found = gather(encoded, reproject(rays, z, encoded))
    hit, visibility = hit_and_visibility(found.geometry, z[None], torch.tensor(0.05))
    assert (hit[..., 1] > 0.5).all() and (hit[..., 0] < 0.05).all()
    assert (visibility[..., 0] > 0.9).all() and (visibility[..., 2] < 0.1).all()


def test_untrained_field_already_renders_measured_depth():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=31, prior=WALL_M)
    render = field.render(rays, encoded)
    seen = render.opacity > 0.5
    assert seen.float().mean() > 0.8
    assert (render.depth_m[seen] - WALL_M).abs().median() < 0.03


@pytest.mark.parametrize("views", [1, 2, 7, 16])
@pytest.mark.parametrize("mode", ["streaming", "reference"])
def test_any_number_of_views_from_1_to_16_renders(views: int, mode: str):
    field = small_field()
    field.sampling = SamplingConfig(mode=mode, coarse=8, fine=8)  # type: ignore[arg-type]
    encoded = field.encode(wall_sources([pose_at(0.02 * i) for i in range(views)]))
    render = field.render(wall_rays(pose_at(0.0), step=101), encoded)
    assert render.logits.shape == (16, 3)
    assert all(torch.isfinite(t).all() for t in (render.logits, render.depth_m, render.rgb, render.entropy))
    assert render.known.all()


def test_more_than_16_views_are_refused():
    field = small_field()
    one = field.encode(wall_sources([pose_at(0.0)]))
    with pytest.raises(ShapeError, match="1 to 16"):
        stack_views([one] * 17)


def test_a_ray_that_no_view_sees_is_unknown():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    away = field.render(wall_rays(pose_at(0.0, 3.14159), step=53), encoded)
    assert not away.known.any()
    assert away.logits.abs().max() == 0 and away.opacity.max() == 0
    torch.testing.assert_close(away.entropy, torch.full_like(away.entropy, torch.log(torch.tensor(3.0)).item()))


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
    keep_all = small_field(occlusion=False)
    assert torch.equal(keep_all.mask_occluded(space).valid, space.valid)


def test_a_blind_view_changes_nothing():
    field = small_field()
    seeing = field.encode(wall_sources(POSES))
    with_blind = field.encode(wall_sources([*POSES, pose_at(0.0, 3.14159)]))
    rays = wall_rays(pose_at(0.0), step=31)
    torch.testing.assert_close(field.render(rays, seeing).logits, field.render(rays, with_blind).logits)


def test_order_of_views_does_not_matter():
    field = small_field()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=31)
    shuffled = encoded.select(torch.tensor([2, 0, 3, 1]))
    torch.testing.assert_close(
        field.render(rays, encoded).logits, field.render(rays, shuffled).logits, atol=1e-5, rtol=1e-4
    )


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


def test_views_without_depth_render_too():
    field = small_field()
    encoded = field.encode(wall_sources(POSES, with_depth=False))
    render = field.render(wall_rays(pose_at(0.0), step=31, prior=0.0), encoded)
    assert torch.isfinite(render.logits).all() and render.known.all()


def test_each_view_is_encoded_by_itself():
    field = small_field()
    views = wall_sources(POSES)
    together = field.encode(views)
    one = field.encode(SourceViews(views.rgb[2:3], views.depth_m[2:3], views.K[2:3], views.T_world_camera[2:3]))
    torch.testing.assert_close(together.feature[2:3], one.feature, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(together.geometry[2:3], one.geometry, atol=1e-4, rtol=1e-4)


def test_mismatched_sources_give_a_shape_error():
    views = wall_sources(POSES)
    with pytest.raises(ShapeError, match="source depth_m"):
        small_field().encode(SourceViews(views.rgb, views.depth_m[:2], views.K, views.T_world_camera))


def test_published_parity_runs_and_differs_from_the_paper():
    published = small_field(parity="published", tokens="samples")
    paper = small_field()
    assert published.cross.head_dim == 4 and paper.cross.head_dim == 8
    encoded = published.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=31)
    z = torch.tensor([[1.9, 2.0, 2.1]]).expand(len(rays.origin), 3)
    thin, _ = published.render_samples(rays, z, encoded)
    assert torch.isfinite(thin.logits).all()
    for name, theirs in published.state_dict().items():
        if paper.state_dict()[name].shape == theirs.shape:
            paper.state_dict()[name].copy_(theirs)
    other, _ = paper.render_samples(rays, z, encoded)
    assert not torch.allclose(thin.opacity, other.opacity, atol=0.01)  # alpha without the interval's length


def test_published_parity_leaves_the_interval_length_out_of_alpha():
    field = small_field(parity="published", tokens="samples")
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=31)
    z = torch.tensor([[1.98, 2.0, 2.02]]).expand(len(rays.origin), 3)
    with torch.no_grad():
        space = contextual_space(rays, z, encoded)
        sigma = field.find_density(space)
        render, _ = field.render_samples(rays, z, encoded)
    torch.testing.assert_close(render.opacity, 1 - torch.exp(-sigma.sum(1)))


def test_reference_sampling_concentrates_fine_samples_on_the_wall():
    field = small_field()
    field.sampling = SamplingConfig(mode="reference", coarse=64, fine=64)
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=101, prior=0.0)
    z = field.sample(rays, encoded)
    assert z.shape[1] == 128
    assert ((z - WALL_M).abs() < 0.2).float().mean() > 0.4


@pytest.mark.slow
def test_the_whole_field_passes_gradcheck():
    torch.manual_seed(1)
    field = SRay(SRayConfig(feature_dim=8, heads=2, encoder=ONE_STAGE), LABELS).double().eval()
    rays = wall_rays(pose_at(0.0), step=500)
    rays = RayBatch(*(t.double() for t in (rays.origin, rays.direction, rays.near_m, rays.far_m, rays.prior_depth_m)))
    z = sample_guided(rays, SamplingConfig(guided=3, free_space=0))
    views = wall_sources(POSES[:2])
    views = SourceViews(*(t.double() for t in (views.rgb, views.depth_m, views.K, views.T_world_camera)))
    encoded = field.encode(views)
    flat = encoded.feature.detach()[:, :, 4:12, 8:16].contiguous().requires_grad_()
    geometry = encoded.geometry.detach()[:, :, 4:12, 8:16].contiguous()
    K = encoded.K.clone()
    K[:, 0, 2] -= 8
    K[:, 1, 2] -= 4
    channel = torch.randint(-1, 3, (2, 16, 16)).to(torch.int16)

    def render(feature: torch.Tensor) -> torch.Tensor:
        sources = EncodedViews(
            feature, encoded.rgb[:, :, 4:12, 8:16].detach(), geometry, K, encoded.T_camera_world, channel
        )
        return field.render_samples(rays, z, sources)[0].logits

    assert torch.autograd.gradcheck(render, (flat,), atol=1e-4)


def test_the_whole_field_passes_gradcheck_with_labels_that_a_source_view_brings():
    field = tiny("sray")
    assert isinstance(field, SRay)
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


def test_unknown_labels_are_the_same_as_none_and_the_switch_turns_labels_off():
    for field, label in ((small_field(), -1), (small_field(source_labels=False), 2)):
        views, rays = wall_sources(POSES[:2]), wall_rays(pose_at(0.1), step=5)
        with_labels = field.encode(replace(views, channel=torch.full((2, 32, 48), label)))
        torch.testing.assert_close(
            field.render(rays, with_labels).logits, field.render(rays, field.encode(views)).logits
        )


def test_labels_of_another_size_than_their_images_are_refused():
    with pytest.raises(ShapeError, match="source channel"):
        labelled_wall(small_field(), torch.zeros(1, 16, 24, dtype=torch.int64), pose_at(0.0))


def test_the_farther_computed_depth_may_be_off_the_wider_is_where_a_view_ray_may_end():
    torch.manual_seed(0)
    encoder = EncoderConfig(channels=(8, 16), blocks=(1, 1), depth=True, computed_depth=True)
    field = SRay(SRayConfig(feature_dim=16, heads=2, encoder=encoder), ROOMS).eval()
    measured = wall_sources([pose_at(0.0), pose_at(0.2)])
    sure, less = (replace(measured, depth_sigma_m=s * measured.depth_m) for s in (0.005, 0.08))
    widths = [field.encode(views).geometry[:, 1] for views in (measured, sure, less)]
    assert torch.equal(widths[1], widths[0])  # no surer than a sensor
    torch.testing.assert_close(widths[2], 8 * widths[0])
