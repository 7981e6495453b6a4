"""The Implicit Ray-Transformer: its points, its tokens, and what it knows without its image."""

from dataclasses import replace

import msgspec
import pytest
import torch

from semantic_mapper.fields.scene.irt import IRT, CarriedLabels, at_measured, no_texture
from tests.fields.scene import wall_rays, wall_sources
from tests.fields.tiny_fields import LABELS, POSES, TINY_IRT


def fitted(**changes: object) -> IRT:
    """A field whose grid stops light everywhere a little, with features that differ from place to place."""
    torch.manual_seed(0)
    config = msgspec.structs.replace(TINY_IRT, carried=0, **changes)
    field = IRT(config, LABELS).eval()
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        field.grid.values[..., 0] = 6 + torch.rand(field.grid.values.shape[:3], generator=generator)
        field.beyond.normal_(generator=generator)
    field.grid.update_occupied()
    field.fitted_steps += 1
    return field


def rays_and_sources(field: IRT):
    return wall_rays(POSES[0]), field.encode(wall_sources(POSES[:2]))


@pytest.mark.parametrize("variant", ["BC", "RTT", "RTC", "RTTC"])
def test_without_its_image_a_ray_is_answered_as_with_a_texture_of_zeros(variant: str) -> None:
    field = fitted(variant=variant)
    rays, sources = rays_and_sources(field)
    others = sources.select(torch.tensor([1]))  # the ray's own view is not among them
    with torch.no_grad():
        without = field.render(rays, others).logits
        wanted = field.logits(at_measured(field.march(rays), field.config.grid), no_texture(rays), None)
        with_image = field.render(rays, sources).logits
    torch.testing.assert_close(without, wanted)
    assert (with_image - without).abs().max() > 1e-4


def test_a_ray_with_measured_depth_ends_there() -> None:
    field = fitted()
    rays, _ = rays_and_sources(field)
    rays = replace(rays, prior_depth_m=torch.full_like(rays.near_m, 1.1))
    with torch.no_grad():
        samples = at_measured(field.march(rays), field.config.grid)
    assert not samples.light.any()
    torch.testing.assert_close(samples.weight.sum(1), torch.ones_like(rays.near_m))
    assert ((samples.weight * samples.z).sum(1) - 1.1).abs().max() < 0.1


def test_rays_that_pass_by_the_box_are_unknown_even_with_their_image() -> None:
    field = fitted()
    rays, sources = rays_and_sources(field)
    moved = msgspec.structs.replace(
        field.shape, grid=msgspec.structs.replace(field.shape.grid, origin_m=(50.0, 50, 50))
    )
    other = IRT(moved, LABELS).eval()
    other.load_state_dict(field.state_dict())
    with torch.no_grad():
        assert bool(field.render(rays, sources).known.all())
        assert not bool(other.render(rays, sources).known.any())


def test_labels_are_carried_to_the_surface_that_they_were_seen_on_and_no_further() -> None:
    carried = CarriedLabels(2, (4, 4), 3)
    carried.depth_m.fill_(2.0)
    carried.channel[0], carried.channel[1] = 1, 2
    carried.K.copy_(torch.tensor([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]]))
    xyz = torch.tensor([[0.0, 0, 2.0], [0, 0, 2.5], [0, 0, -2.0]])
    both = carried(xyz, torch.ones(2))
    torch.testing.assert_close(both[0], torch.tensor([0, 0.5, 0.5, 2 / 3]))
    assert float(both[1:, -1].max()) < 1e-3  # behind the surface, behind the camera
    first = carried(xyz, torch.tensor([[1.0, 0.0]]))
    torch.testing.assert_close(first[0], torch.tensor([0, 1.0, 0, 0.5]))
