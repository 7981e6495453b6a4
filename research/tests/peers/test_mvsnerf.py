from dataclasses import replace

import pytest
import torch

from research.peers.cost_volume import Sweep, cost_volume, nearest_views
from research.peers.mvsnerf import MVSNeRF
from research.tests.peers.tiny_peers import tiny_peer
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.scene.grid import encoded_size
from tests.fields.scene import INTRINSICS, WALL_M, pose_at, wall_rays, wall_sources
from tests.fields.tiny_fields import POSES, assert_gradients_are_right


def mvsnerf() -> MVSNeRF:
    field = tiny_peer("mvsnerf")
    assert isinstance(field, MVSNeRF)
    return field


@pytest.mark.parametrize("views", [1, 2, 7, 16])
@pytest.mark.parametrize("with_depth", [True, False])
def test_any_number_of_views_from_1_to_16_renders_with_and_without_depth(views: int, with_depth: bool):
    field = mvsnerf()
    encoded = field.encode(wall_sources([pose_at(0.02 * i) for i in range(views)], with_depth=with_depth))
    render = field.render(wall_rays(pose_at(0.0), step=101, prior=WALL_M * with_depth), encoded)
    assert render.logits.shape == (16, 3)
    assert all(torch.isfinite(t).all() for t in (render.logits, render.depth_m, render.rgb, render.entropy))
    assert render.known.all()


def test_the_nearest_views_are_those_that_stand_near_and_look_the_same_way():
    encoded = mvsnerf().encode(wall_sources([pose_at(0.5), pose_at(0.05), pose_at(0.0, 1.5), pose_at(-0.1, 0.05)]))
    assert nearest_views(wall_rays(pose_at(0.0), step=9), encoded, 3).tolist() == [1, 3, 0]
    assert nearest_views(wall_rays(pose_at(0.0), step=9), encoded, 16).tolist() == [1, 3, 0, 2]


def test_features_of_all_views_agree_on_the_plane_that_the_wall_stands_on():
    """With the wall's own colours as features, the variance is least where the sweep passes the wall at 2 m."""
    field = mvsnerf()
    encoded = field.encode(wall_sources([pose_at(0.0), pose_at(0.4), pose_at(-0.4)]))
    colours = type(encoded)(
        encoded.rgb, encoded.rgb, encoded.geometry, encoded.K, encoded.T_camera_world, encoded.channel
    )
    sweep = Sweep(planes=33, near_m=1.0, far_m=1e3)
    cost = cost_volume(colours, sweep, slots=3)[0]
    assert cost.shape == (3 + 12, 33, 8, 12)
    wall_plane, near_plane = 16, 8  # inverse depths 0.5 and 0.74
    seen_by_all = cost[6::4].amin(0) > 0  # masks of the three views
    middle = seen_by_all[wall_plane] & seen_by_all[near_plane]
    assert middle.sum() > 20
    variance = cost[:3].mean(0)
    assert (variance[wall_plane][middle] < 0.2 * variance[near_plane][middle]).float().mean() > 0.9


class _CostItself(torch.nn.Module):
    """In place of the 3D network: the first channels of the cost volume, whose first three are variances."""

    def forward(self, cost: torch.Tensor) -> torch.Tensor:
        return cost[:, :4]


def test_a_sample_looks_up_the_volume_at_its_own_place():
    """Seen aslant by a camera that is no source: with the wall's colours as features, the views agree on the wall.

    The wall is at another depth in every column, so that a volume which is mirrored or shifted agrees elsewhere.
    """
    field = tiny_peer("mvsnerf")
    assert isinstance(field, MVSNeRF)
    field.sweep = Sweep(planes=64, near_m=1.0, far_m=8.0)
    field.volume_net = _CostItself()  # pyright: ignore[reportAttributeAccessIssue]
    looked_up: list[torch.Tensor] = []
    field.trunk.register_forward_pre_hook(lambda _, given: looked_up.append(given[0]))
    encoded = field.encode(wall_sources([pose_at(0.0, 0.4), pose_at(0.4, 0.35), pose_at(-0.4, 0.4)]))
    rays = wall_rays(pose_at(0.1, 0.4), step=7)
    wall = (WALL_M - rays.origin[:, 2]) / rays.direction[:, 2]
    depths = wall[:, None] * torch.tensor([0.7, 0.8, 0.9, 1.0, 1.12, 1.25, 1.5])
    with torch.no_grad():
        field.render_samples(rays, depths, replace(encoded, feature=encoded.rgb))
    place = encoded_size(3, field.config.position_frequencies)
    variance, masks = looked_up[0][..., place : place + 3].mean(-1), looked_up[0][..., place + 7 :: 4]
    seen_by_all = masks.amin((1, 2)) > 0  # at every depth
    assert seen_by_all.sum() > 50
    assert (variance[seen_by_all].argmin(1) == 3).float().mean() > 0.9


def test_a_view_rendered_in_chunks_is_swept_once_and_weights_that_change_sweep_it_anew():
    field = mvsnerf()
    swept: list[int] = []
    field.volume_net.register_forward_hook(lambda *_: swept.append(1))
    encoded = field.encode(wall_sources(POSES))

    def render(x: float = 0.0, yaw: float = 0.0):
        depth = torch.full((32, 48), WALL_M).numpy()
        return render_image(field, encoded, INTRINSICS, pose_at(x, yaw), depth, field.sampling, 200)

    first = render()
    assert len(swept) == 1
    torch.testing.assert_close(render().logits, first.logits)
    assert len(swept) == 1
    with torch.no_grad():
        for p in field.volume_net.parameters():
            p.mul_(1.5)
    assert (render().logits - first.logits).abs().max() > 1e-6
    assert len(swept) == 2
    render(0.3, -0.15)  # another reference
    assert len(swept) == 3


def test_training_never_uses_a_volume_without_gradients():
    field = mvsnerf().train()
    encoded = field.encode(wall_sources(POSES))
    rays = wall_rays(pose_at(0.0), step=101)
    with torch.no_grad():
        field.render(rays, encoded)
    field.render(rays, encoded).logits.sum().backward()
    first = next(iter(field.volume_net.parameters()))
    assert first.grad is not None and first.grad.abs().max() > 0


def test_world_frame_does_not_matter():
    field = mvsnerf()
    views, rays = wall_sources(POSES), wall_rays(pose_at(0.0), step=31)
    T = torch.from_numpy(pose_at(1.7, 0.8)).float()
    T[1, 3] = -0.4
    moved_views = type(views)(views.rgb, views.depth_m, views.K, T @ views.T_world_camera)
    moved_rays = type(rays)(
        rays.origin @ T[:3, :3].T + T[:3, 3], rays.direction @ T[:3, :3].T, rays.near_m, rays.far_m, rays.prior_depth_m
    )
    a = field.render(rays, field.encode(views)).logits
    b = field.render(moved_rays, field.encode(moved_views)).logits
    torch.testing.assert_close(a, b, atol=2e-3, rtol=2e-3)


def test_the_whole_field_passes_gradcheck():
    assert_gradients_are_right(mvsnerf())
