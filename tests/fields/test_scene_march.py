"""The compiled loops of the scene grid against plain torch."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from semantic_mapper.fields.scene.march import (
    BIAS,
    CELL,
    STEP,
    STOP_BELOW,
    GridArrays,
    LossWeights,
    RayArrays,
    RayResults,
    SampleLists,
    TargetArrays,
    add_total_variation,
    gather,
    march,
    photometric_rays,
    scatter_grid,
)

SHAPE = (9, 14, 6)
RAYS = 200
LOSS = LossWeights(opacity=0.05, min_weight=0.0)


def random_grid(seed: int = 0, channels: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    """Raw values with a few opaque places, and cells of which a third are empty."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(*SHAPE, channels, generator=generator)
    values[..., 0] = 3 * values[..., 0] + 4
    occupied = (torch.rand(2, 4, 2, generator=generator) > 0.3).to(torch.uint8)
    return values, occupied


def random_rays() -> RayArrays:
    """From outside and inside of the grid, some past it, some along an axis."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor(SHAPE) - 1
    origin = (torch.rand(RAYS, 3, generator=generator) * 3 - 1) * size
    towards = torch.rand(RAYS, 3, generator=generator) * size - origin
    towards[:10, :2] = 0
    direction = towards * (0.02 + 0.1 * torch.rand(RAYS, 1, generator=generator))
    near, far = torch.full((RAYS,), 0.3), torch.full((RAYS,), torch.inf)
    return RayArrays(*(t.numpy() for t in (origin, direction, near, far, torch.rand(RAYS, generator=generator))))


def plain_gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    size = points.new_tensor([n - 1 for n in values.shape[:3]])
    place = (points.reshape(1, -1, 1, 1, 3) / size * 2 - 1).flip(-1)  # grid_sample's x is the last axis
    volume = values.permute(3, 0, 1, 2)[None]
    read = functional.grid_sample(volume, place, mode="bilinear", padding_mode="border", align_corners=True)
    return read[0, :, :, 0, 0].T.reshape(*points.shape[:-1], values.shape[3])


def plain_samples(values: torch.Tensor, occupied: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """All samples of the random rays: z, weight (R, S), light (R,) that gets through, and points (R, S, 3)."""
    o, d, near, far, jitter = map(torch.from_numpy, random_rays())
    top = torch.tensor([n - 1.0 for n in SHAPE])
    along = d.abs() < 1e-9
    a, b = -o / torch.where(along, 1, d), (top - o) / torch.where(along, 1, d)
    inside = (~along | ((o >= 0) & (o <= top))).all(1)
    start = torch.maximum(near, torch.where(along, -torch.inf, torch.minimum(a, b)).amax(1))
    end = torch.minimum(far, torch.where(along, torch.inf, torch.maximum(a, b)).amin(1))
    interval = STEP / d.norm(dim=1)
    count = torch.ceil((end - start) / interval - jitter) * (inside & (end > start))
    k = torch.arange(int(count.max()))
    z = start[:, None] + (k + jitter[:, None]) * interval[:, None]
    valid = k < count[:, None]
    z = torch.where(valid, z, near[:, None])
    points = torch.minimum((o[:, None] + z[..., None] * d[:, None]).clamp(min=0), top)
    cell = torch.minimum(points.long(), top.long() - 1) // CELL
    valid = valid & (occupied[cell[..., 0], cell[..., 1], cell[..., 2]] > 0)
    depth = STEP * functional.softplus(plain_gather(values[..., :1], points)[..., 0] + BIAS) * valid
    depth = depth * (torch.exp(depth - torch.cumsum(depth, 1)) >= STOP_BELOW)
    before = torch.cumsum(depth, 1) - depth
    return z, torch.exp(-before) * -torch.expm1(-depth), torch.exp(-depth.sum(1)), points


def test_gather_reads_as_grid_sample_does_and_sends_gradients_back() -> None:
    values, _ = random_grid()
    points = torch.rand(7, 50, 3) * (torch.tensor(SHAPE) + 1) - 1  # some beyond the edge
    seen = torch.randn(7, 50, 4)
    results = []
    for read in (gather, plain_gather):
        leaf = values.clone().requires_grad_()
        out = read(leaf, points)
        (out * seen).sum().backward()
        results.append((out.detach(), leaf.grad))
    torch.testing.assert_close(results[0], results[1], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kept", [3, 16, 64])
def test_march_finds_the_samples_of_greatest_weight_with_exact_gradients(kept: int) -> None:
    values, occupied = random_grid()
    ours, plain = values.clone().requires_grad_(), values.clone().requires_grad_()
    z, weight, light = march(ours, occupied, random_rays(), kept)
    every_z, every_weight, wanted_light, _ = plain_samples(plain, occupied)
    wanted, index = every_weight.topk(min(kept, every_weight.shape[1]), dim=1)
    wanted_z = every_z.gather(1, index)
    assert (weight > 0.01).sum() > 2 * RAYS / 3  # there is something to see
    assert (z.diff() >= 0).all()
    torch.testing.assert_close(
        weight.sort(1, descending=True).values[:, : wanted.shape[1]], wanted, atol=1e-5, rtol=1e-4
    )
    torch.testing.assert_close(light, wanted_light, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close((z * weight).sum(1), (wanted_z * wanted).sum(1), atol=1e-4, rtol=1e-4)
    by_light = torch.randn(RAYS, generator=torch.Generator().manual_seed(5))
    for w, at, rest in ((weight, z, light), (wanted, wanted_z, wanted_light)):
        ((w * torch.sin(5 * at)).sum() + (rest * by_light).sum()).backward()
    torch.testing.assert_close(ours.grad, plain.grad, atol=1e-4, rtol=1e-3)


def photometric(values: torch.Tensor, occupied: torch.Tensor) -> tuple[np.ndarray, RayResults, TargetArrays]:
    """Gradient by the values, results and targets of the compiled step."""
    rng = np.random.default_rng(3)
    inverse = np.where(rng.random(RAYS) < 0.5, rng.uniform(0.05, 0.5, RAYS), 0).astype(np.float32)
    colour, sky = rng.random((2, RAYS, 3), np.float32)
    targets = TargetArrays(colour, inverse, rng.uniform(0.8, 1.2, (RAYS, 3)).astype(np.float32), sky)
    samples = SampleLists.empty(RAYS, SHAPE, 4)
    results = RayResults(*(np.empty((RAYS, 3), np.float32) for _ in range(3)))
    grid = GridArrays(values.numpy(), occupied.numpy())
    photometric_rays(RAYS, grid, random_rays(), targets, LOSS, samples, results)
    gradient = np.zeros(values.shape, np.float32)
    scatter_grid(len(gradient), samples, gradient)
    return gradient, results, targets


def plain_loss(
    values: torch.Tensor, occupied: torch.Tensor, targets: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss and colours of the same rays in torch."""
    wanted, inverse, gain, sky = targets
    z, weight, light, points = plain_samples(values, occupied)
    each = torch.sigmoid(plain_gather(values, points)[..., 1:])
    seen = gain * ((weight[..., None] * each).sum(1) + light[:, None] * sky)
    apart = (each - (wanted / gain)[:, None]).square().sum(-1)
    cost = ((1 / z - inverse[:, None]).abs() / LOSS.reach).clamp(max=1)
    depth = ((weight * cost).sum(1) + light) * (inverse > 0)
    per_point = LOSS.point_colour * (weight.detach() * apart).sum() / RAYS
    loss = (seen - wanted).square().mean() + per_point + LOSS.opacity * (1 - light).mean()
    return loss + LOSS.depth * depth.sum() / RAYS, seen


def test_the_photometric_step_has_the_gradients_of_plain_torch() -> None:
    values, occupied = random_grid()
    gradient, results, targets = photometric(values, occupied)
    leaves = [torch.from_numpy(t).clone() for t in targets]
    leaf, gain, sky = values.clone().requires_grad_(), leaves[2].requires_grad_(), leaves[3].requires_grad_()
    # The per-point colour is compared with the image without its gain, through which no gradient goes.
    loss, seen = plain_loss(leaf, occupied, (leaves[0], leaves[1], gain, sky))
    loss.backward()
    torch.testing.assert_close(torch.from_numpy(results.colour), seen.detach(), atol=1e-5, rtol=1e-4)
    assert leaf.grad is not None and sky.grad is not None
    torch.testing.assert_close(torch.from_numpy(gradient), leaf.grad, atol=1e-6, rtol=1e-3)
    torch.testing.assert_close(torch.from_numpy(results.sky_gradient), sky.grad, atol=1e-6, rtol=1e-3)


def test_total_variation_has_the_gradient_of_the_huber_loss_of_neighbours() -> None:
    values, _ = random_grid()
    leaf = values.clone().requires_grad_()
    huber = torch.nn.functional.huber_loss
    steps = torch.cat([leaf.diff(dim=d).flatten() for d in range(3)])
    huber(steps, torch.zeros_like(steps), reduction="sum").backward()
    gradient = np.full(values.shape, 1e-20, np.float32)
    add_total_variation(len(gradient), values.numpy(), gradient, 1.0, 1.0)
    torch.testing.assert_close(torch.from_numpy(gradient), leaf.grad, atol=1e-4, rtol=1e-4)
    untouched = np.zeros(values.shape, np.float32)
    add_total_variation(len(untouched), values.numpy(), untouched, 1.0, 1.0)
    assert not untouched.any()
