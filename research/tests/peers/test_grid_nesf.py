"""NeSF on densities: where its vertices lie, what turning changes, and logits of points and rays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from research.peers.grid_nesf import GridNesf, GridNesfConfig, Placement, density_cells, smooth_opacity
from semantic_mapper.config import GridConfig
from semantic_mapper.fields.scene.grid import SceneGrid
from semantic_mapper.labels import KLEVR

BOX = GridConfig(origin_m=(-2.0, -2.0, 0.0), voxel_m=0.25, shape=(17, 17, 9))
SIZE = 16


def some_grid() -> SceneGrid:
    """A block away from the middle, and nothing else."""
    grid = SceneGrid(BOX)
    grid.values[..., 0] = -10.0
    grid.values[9:13, 3:12, 2:5, 0] = 10.0
    grid.update_occupied()
    return grid


def some_points(count: int = 200) -> torch.Tensor:
    low, high = np.array(BOX.origin_m), np.array(BOX.origin_m) + (np.array(BOX.shape) - 1) * BOX.voxel_m
    return torch.from_numpy(np.random.default_rng(0).uniform(low, high, (count, 3)).astype(np.float32))


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.9])
def test_vertices_lie_where_the_world_says_and_hold_the_box_however_it_is_turned(angle: float) -> None:
    placement = Placement(BOX, SIZE, angle)
    world = placement.world()
    assert world.shape == (SIZE, SIZE, 2)
    expected = torch.stack(torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij"), -1)
    found = placement.vertices(torch.cat((world, torch.zeros(SIZE, SIZE, 1)), 2))
    assert torch.allclose(found[..., :2], expected.float(), atol=1e-4)
    heights = torch.tensor(((0.0, 0.0, 0.0), (0.0, 0.0, 2.0)))  # of the box
    assert torch.allclose(placement.vertices(heights)[:, 2], torch.tensor((0.0, SIZE / 2 - 1)), atol=1e-5)
    found = placement.vertices(some_points())
    assert found.min() >= 0 and (found <= torch.tensor((SIZE, SIZE, SIZE // 2)) - 1).all()


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_opacity_at_a_vertex_is_the_grid_s_between_its_voxels(angle: float) -> None:
    grid, placement = some_grid(), Placement(BOX, 24, angle)  # vertices so close that nothing is averaged
    seen = density_cells(smooth_opacity(grid, 24), placement)
    for cell, rho in zip(seen.cells[::7], seen.rho[::7, 0], strict=True):
        x, y = placement.world()[cell[0], cell[1]]
        z = BOX.origin_m[2] + cell[2] * placement.spacing()[2]
        place = (torch.tensor((float(x), float(y), float(z))) - torch.tensor(BOX.origin_m)) / BOX.voxel_m
        low = place.floor().long()
        expected = 0.0
        for corner in np.ndindex(2, 2, 2):
            at = low + torch.tensor(corner)
            if ((at >= 0) & (at < torch.tensor(BOX.shape))).all():
                weight = (1 - (place - at).abs()).clamp(min=0).prod()
                expected += float(weight * grid.alpha()[tuple(at)])
        assert float(rho) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_cells_are_those_of_what_is_there(angle: float) -> None:
    opacity = smooth_opacity(some_grid(), SIZE)
    seen = density_cells(opacity, Placement(BOX, SIZE, angle))
    assert 0 < len(seen.cells) < SIZE**3 / 4
    near = seen.near(torch.tensor(((0.75, -0.2, 0.7), (-1.5, 1.5, 1.8))))
    rho = (torch.cat((seen.rho, torch.zeros(1, 1)))[near.rows, 0] * near.weights).sum(1)
    assert rho[0] > 0.5 and rho[1] == 0


def test_a_turned_scene_is_the_same_scene_seen_at_an_angle() -> None:
    torch.manual_seed(0)
    model = GridNesf(KLEVR, GridNesfConfig(size=SIZE, width=4))
    opacity, points = smooth_opacity(some_grid(), SIZE), some_points()
    by_angle = density_cells(opacity, Placement(BOX, SIZE, np.pi / 2))
    turned = density_cells(opacity.rot90(1, (1, 2)).contiguous(), Placement(BOX, SIZE))
    quarter = torch.stack((-points[:, 1], points[:, 0], points[:, 2]), 1)
    with torch.no_grad():
        first = model.logits(model.features(by_angle), by_angle.near(points))
        second = model.logits(model.features(turned), turned.near(quarter))
        straight = density_cells(opacity, Placement(BOX, SIZE))
        third = model.logits(model.features(straight), straight.near(points))
    assert torch.allclose(first, second, atol=1e-4)
    assert not torch.allclose(first, third, atol=1e-2)


def test_a_ray_has_the_logits_of_its_samples_and_of_nothing_for_the_rest() -> None:
    model = GridNesf(KLEVR, GridNesfConfig(size=SIZE, width=4))
    logits = torch.randn(3, len(KLEVR))
    with torch.no_grad():
        model.nothing.copy_(torch.arange(6.0))
        found = model.composite(logits, torch.tensor((1.0, 0.25, 0.25)), torch.tensor((0, 2, 2)), 3)
    assert torch.allclose(found[0], logits[0])
    assert torch.equal(found[1], torch.arange(6.0))
    assert torch.allclose(found[2], (logits[1] + logits[2]) / 4 + torch.arange(6.0) / 2)
