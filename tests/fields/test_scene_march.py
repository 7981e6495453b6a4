"""The compiled loops of the scene grid against plain torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from semantic_mapper.fields.scene.march import (
    BIAS,
    STEP,
    GridArrays,
    GridRays,
    LossWeights,
    RayResults,
    SampleLists,
    TargetArrays,
    adam_grid,
    add_total_variation,
    gather,
    march,
    most_samples,
    photometric_rays,
    reference_gather,
    reference_march,
    reference_samples,
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


def random_rays(seed: int = 0, count: int = RAYS) -> GridRays:
    """From outside and inside of the grid, some past it, some along an axis."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(SHAPE) - 1
    origin = (torch.rand(count, 3, generator=generator) * 3 - 1) * size
    towards = torch.rand(count, 3, generator=generator) * size - origin
    towards[:10, :2] = 0
    direction = towards * (0.02 + 0.1 * torch.rand(count, 1, generator=generator))
    near = torch.full((count,), 0.3)
    return GridRays(origin, direction, near, torch.full((count,), torch.inf), torch.rand(count, generator=generator))


def doubled(rays: GridRays) -> GridRays:
    return GridRays(*(t.double() for t in (rays.origin, rays.direction, rays.near, rays.far, rays.jitter)))


def test_gather_reads_as_grid_sample_does_and_sends_gradients_back() -> None:
    values, _ = random_grid()
    points = torch.rand(7, 50, 3) * (torch.tensor(SHAPE) + 1) - 1  # some beyond the edge
    seen = torch.randn(7, 50, 4)
    results = []
    for read in (gather, reference_gather):
        leaf = values.clone().requires_grad_()
        out = read(leaf, points)
        (out * seen).sum().backward()
        results.append((out.detach(), leaf.grad))
    torch.testing.assert_close(results[0], results[1], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kept", [3, 16, 64])
def test_march_finds_the_samples_of_greatest_weight_with_exact_gradients(kept: int) -> None:
    values, occupied = random_grid()
    rays = random_rays()
    generator = torch.Generator().manual_seed(5)
    by_weight, by_light = torch.randn(RAYS, kept, generator=generator), torch.randn(RAYS, generator=generator)
    ours, plain = values.clone().requires_grad_(), values.clone().requires_grad_()
    found = march(ours, occupied, rays, kept)
    z, weight, light = reference_march(plain, occupied, rays, kept)
    assert (found.weight.detach() > 0.01).sum() > 2 * RAYS / 3  # there is something to see
    torch.testing.assert_close(found.weight, weight, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.light, light, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.z * (weight > 0), z * (weight > 0), atol=1e-4, rtol=1e-5)
    for w, rest in ((found.weight, found.light), (weight, light)):
        ((w * by_weight).sum() + (rest * by_light).sum()).backward()
    torch.testing.assert_close(ours.grad, plain.grad, atol=1e-4, rtol=1e-3)


def test_the_plain_march_passes_gradcheck_in_double() -> None:
    values, occupied = random_grid(1, 1)
    rays = doubled(random_rays(1, 6))

    def weights(density: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = march(density, occupied, rays, 12)
        return found.weight, found.light

    assert torch.autograd.gradcheck(weights, (values.double().requires_grad_(),), fast_mode=True, atol=1e-6)


def photometric(values: torch.Tensor, occupied: torch.Tensor) -> tuple[np.ndarray, RayResults, TargetArrays]:
    """Gradient by the values, results and targets of the compiled step."""
    rng = np.random.default_rng(3)
    inverse = np.where(rng.random(RAYS) < 0.5, rng.uniform(0.05, 0.5, RAYS), 0).astype(np.float32)
    colour, sky = rng.random((2, RAYS, 3), np.float32)
    targets = TargetArrays(colour, inverse, rng.uniform(0.8, 1.2, (RAYS, 3)).astype(np.float32), sky)
    samples = SampleLists.empty(RAYS, most_samples(SHAPE), 4)
    results = RayResults(*(np.empty((RAYS, 3), np.float32) for _ in range(3)))
    grid = GridArrays(values.numpy(), occupied.numpy(), STEP, BIAS)
    photometric_rays(RAYS, grid, random_rays().arrays(), targets, LOSS, samples, results)
    gradient = np.zeros(values.shape, np.float32)
    scatter_grid(len(gradient), samples, gradient)
    return gradient, results, targets


def plain_loss(
    values: torch.Tensor, occupied: torch.Tensor, targets: tuple[torch.Tensor, ...]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss and colours of the same rays in torch."""
    wanted, inverse, gain, sky = targets
    rays = random_rays()
    z, weight, light = reference_samples(values, occupied, rays)
    top = torch.tensor(SHAPE) - 1
    each = torch.sigmoid(reference_gather(values, torch.minimum(rays.points(z).clamp(min=0), top))[..., 1:])
    seen = gain * ((weight[..., None] * each).sum(1) + light[:, None] * sky)
    apart = (each - (wanted / gain)[:, None]).square().sum(-1)
    cost = ((1 / z - inverse[:, None]).abs() / LOSS.reach).clamp(max=1)
    depth = ((weight * cost).sum(1) + light) * (inverse > 0)
    per_point = LOSS.point_colour * (weight.detach() * apart).sum() / RAYS
    return (seen - wanted).square().mean() + per_point + LOSS.opacity * (
        1 - light
    ).mean() + LOSS.depth * depth.sum() / RAYS, seen


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


def test_every_loop_gives_the_same_bits_on_any_number_of_threads() -> None:
    before = torch.get_num_threads()
    found: list[list[np.ndarray]] = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            values, occupied = random_grid()
            gradient, results, _ = photometric(values, occupied)
            leaf = values.clone().requires_grad_()
            marched = march(leaf, occupied, random_rays())
            marched.weight.square().sum().backward()
            assert leaf.grad is not None
            stepped, first, second = values.numpy().copy(), np.zeros_like(gradient), np.zeros_like(gradient)
            add_total_variation(len(gradient), stepped, gradient, 1e-3, 1e-3)
            rate = np.ones(SHAPE, np.float32)
            adam_grid(len(gradient), stepped, gradient, first, second, rate, 0.1, 0.1, 0.9, 0.99, 0.1, 0.01)
            found.append([stepped, first, *results, marched.z.numpy(), leaf.grad.numpy()])
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_adam_steps_as_torch_does_and_leaves_what_has_no_gradient() -> None:
    values, _ = random_grid()
    gradient = np.random.default_rng(0).normal(size=(3, *values.shape)).astype(np.float32)
    gradient[:, :3] = 0
    stepped, first, second = (
        values.numpy().copy(),
        np.zeros(values.shape, np.float32),
        np.zeros(values.shape, np.float32),
    )
    leaf = values.clone().requires_grad_()
    optimiser = torch.optim.Adam([leaf], 0.1, betas=(0.9, 0.99), eps=1e-15)
    for step, g in enumerate(gradient, 1):
        leaf.grad = torch.from_numpy(g.copy())
        optimiser.step()
        rate = np.ones(SHAPE, np.float32)
        adam_grid(len(g), stepped, g, first, second, rate, 0.1, 0.1, 0.9, 0.99, 1 - 0.9**step, 1 - 0.99**step)
        assert not g.any()
    torch.testing.assert_close(torch.from_numpy(stepped), leaf.detach(), atol=1e-5, rtol=1e-5)
    assert np.array_equal(stepped[:3], values.numpy()[:3])


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
