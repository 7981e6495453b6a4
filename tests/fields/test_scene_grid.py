"""A grid as a field: what it claims, its files, and its two ways to render."""

import torch

from semantic_mapper.config import GridConfig, GridFieldConfig
from semantic_mapper.fields.learned import build_field
from semantic_mapper.fields.scene.grid import NOTHING, GridField, RaySamples, at_resolution
from semantic_mapper.fields.views import EncodedViews
from tests.fields.scene import WALL_M, pose_at, wall_colour, wall_rays, wall_sources
from tests.fields.tiny_fields import LABELS, POSES, assert_unknown

BOX = GridConfig(origin_m=(-3.0, -2.0, 0.5), voxel_m=0.1, shape=(61, 41, 21))  # the wall is in it


def wall_field(features: int = 0) -> GridField:
    """The textured wall, opaque from z = WALL_M on."""
    field = build_field("grid", GridFieldConfig(grid=BOX, features=features), LABELS)
    assert isinstance(field, GridField)
    axes = [torch.arange(n) * BOX.voxel_m + o for n, o in zip(BOX.shape, BOX.origin_m, strict=True)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    with torch.no_grad():
        field.grid.values[..., 0] = torch.where(z >= WALL_M - 0.01, 20.0, NOTHING)
        field.grid.values[..., 1:] = torch.logit(wall_colour(x, y).clamp(0.02, 0.98))
        field.grid.sky[:] = 5.0
    field.grid.update_occupied()
    field.fitted_steps += 1
    return field.eval()


class LeftRight(GridField):
    """Knows class 1 left of x = 0, class 2 right of it."""

    def classify(self, samples: RaySamples, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
        right = samples.points[..., 0] * BOX.voxel_m + BOX.origin_m[0] > 0
        each = torch.nn.functional.one_hot(torch.where(right, 2, 1), 3).float()
        return 5 * (samples.weight[..., None] * each).sum(1), self.known(samples)


def test_a_fitted_grid_renders_colour_and_depth_and_claims_no_class() -> None:
    field = wall_field()
    rays = wall_rays(pose_at(0.1, 0.05), step=7)
    render = field.render(rays, field.encode(wall_sources(POSES[:1])))
    hit = rays.origin + (WALL_M / rays.direction[:, 2:]) * rays.direction
    inside = (hit[:, 0].abs() < 2.7) & (hit[:, 1].abs() < 1.7)
    assert inside.sum() > 100 and (render.opacity[inside] > 0.99).all()
    assert (render.depth_m - (WALL_M - rays.origin[:, 2]))[inside].abs().max() < 0.1
    assert (render.rgb - wall_colour(hit[:, 0], hit[:, 1]))[inside].abs().max() < 0.1
    assert not render.known.any() and not render.logits.any()
    field.fitted_steps.zero_()
    assert_unknown(field.render(rays, field.encode(wall_sources(POSES))))


def test_a_kind_says_what_samples_mean_and_only_where_something_is() -> None:
    field = LeftRight(GridFieldConfig(grid=BOX), LABELS)
    field.load_state_dict(wall_field().state_dict())
    rays = wall_rays(pose_at(0.0))
    render = field.render(rays, field.encode(wall_sources(POSES[:1])))
    x = WALL_M / rays.direction[:, 2] * rays.direction[:, 0]
    assert render.known.float().mean() > 0.9
    sure = render.known & (x.abs() > 0.1)
    assert (render.logits.argmax(1) == torch.where(x > 0, 2, 1))[sure].all()
    away = field.render(wall_rays(pose_at(0.0, 3.1415), step=31), field.encode(wall_sources(POSES[:1])))
    assert not away.known.any()


def test_a_resampled_grid_shows_the_same() -> None:
    field = wall_field()
    finer = at_resolution(GridConfig(origin_m=BOX.origin_m, voxel_m=0.05, shape=(121, 81, 41)), 100)
    other = GridField(GridFieldConfig(grid=finer), LABELS)
    other.grid = field.grid.resampled(finer)
    other.fitted_steps += 1
    rays, sources = wall_rays(pose_at(0.0), step=31), field.encode(wall_sources(POSES[:1]))
    torch.testing.assert_close(other.render(rays, sources).rgb, field.render(rays, sources).rgb, atol=0.05, rtol=0)
