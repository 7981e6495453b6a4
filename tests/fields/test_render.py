import dataclasses

import numpy as np
import pytest
import torch

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.render import (
    COLOUR_STEP,
    DEPTH_STEP,
    UNSURE,
    View,
    fill_between_rays,
    render_sparse_view,
    render_view,
)
from semantic_mapper.labels import make_label_set
from semantic_mapper.types import CameraIntrinsics, FieldRender, RayBatch

CAMERA = CameraIntrinsics(30.0, 30.0, 19.5, 14.5, 40, 30)
LABELS = make_label_set("two", ("left", "right"), ids=(1, 2), ignore_id=0)
SAMPLING = SamplingConfig()
NOTHING = EncodedViews(*(torch.zeros(1) for _ in range(6)))


@dataclasses.dataclass
class Halves:
    """Says "left" of rays to the left of ``border`` (pixels), sure; nothing of the rows above ``unknown_above``."""

    border: float = 17.0
    unknown_above: int = 0
    sure: float = 6.0
    rays: int = 0
    label_set = LABELS

    def render(self, rays: RayBatch, sources: EncodedViews) -> FieldRender:
        u = rays.direction[:, 0] / rays.direction[:, 2] * CAMERA.fx + CAMERA.cx
        v = rays.direction[:, 1] / rays.direction[:, 2] * CAMERA.fy + CAMERA.cy
        self.rays += len(u)
        logits = self.sure * torch.stack(((u < self.border).float(), (u >= self.border).float()), 1)
        known = v > self.unknown_above - 0.5
        ones = torch.ones_like(u)
        return FieldRender(logits, rays.prior_depth_m, ones, torch.zeros(len(u), 3), ones, known)


PRIOR, GREY = np.full((30, 40), 2.0, np.float32), np.full((30, 40, 3), 90, np.uint8)


def sparse(field: Halves, prior: np.ndarray = PRIOR, fraction: float = 0.99, rgb: np.ndarray = GREY):
    return render_sparse_view(View(field, NOTHING, CAMERA, np.eye(4), prior, SAMPLING, 128), rgb, fraction)  # type: ignore[arg-type]


def dense(field: Halves):
    return render_view(View(field, NOTHING, CAMERA, np.eye(4), PRIOR, SAMPLING, 128))  # type: ignore[arg-type]


@pytest.mark.parametrize("border", [15.5, 16.5, 17.5, 18.5])
def test_a_border_between_classes_is_found_to_the_pixel_with_a_fifth_of_the_rays(border: float):
    field = Halves(border)
    p, known, depth, rays = sparse(field)
    expected, _, expected_depth = dense(Halves(border))
    np.testing.assert_array_equal(p.argmax(2), expected.argmax(2))
    np.testing.assert_allclose(p, expected, atol=1e-6)
    np.testing.assert_allclose(depth, expected_depth, atol=1e-6)
    assert known.all()
    assert rays == field.rays < 0.2 * 30 * 40


def test_pixels_whose_depth_is_another_than_their_neighbours_have_rays_of_their_own():
    prior = PRIOR.copy()
    prior[:, 31] = 1.0  # a pole, one pixel wide, between the columns of every coarser grid
    _, _, depth, _ = sparse(Halves(), prior)
    np.testing.assert_array_equal(depth[:, 31], 1.0)
    np.testing.assert_array_equal(depth[:, 25], 2.0)


def test_the_fraction_is_a_limit_and_the_most_uncertain_go_first():
    prior = PRIOR.copy()
    prior[10] = 1.0
    needed = sparse(Halves(17.5))[3]
    p, _, _, rays = sparse(Halves(17.5), prior, fraction=needed / 1200)
    assert rays == needed < sparse(Halves(17.5), prior)[3]
    np.testing.assert_array_equal(p.argmax(2), dense(Halves(17.5))[0].argmax(2))
    assert sparse(Halves(), fraction=0.0)[3] == 80


def test_images_of_another_size_than_the_view_are_refused():
    with pytest.raises(ShapeError, match="depth prior"):
        sparse(Halves(), np.ones((30, 20), np.float32))
    with pytest.raises(ShapeError, match="view rgb"):
        sparse(Halves(), rgb=np.zeros((60, 40, 3), np.uint8))


def filled(step: int, p: np.ndarray, known: np.ndarray, depth: np.ndarray, prior: np.ndarray, rgb: np.ndarray):
    """The rule of ``fill_between_rays``, all pixels at once: new p, known, depth, uncertainty."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width]

    def on_grid(place: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
        after = -(-place // step) * step
        return place // step * step, np.where(after < size, after, after - step)

    corners = [(j, i) for j in on_grid(v, height) for i in on_grid(u, width)]
    p4, known4, depth4 = (np.stack([image[at] for at in corners]) for image in (p, known, depth))
    prior4, rgb4 = (np.stack([image[at] for at in corners]).astype(float) for image in (prior, rgb))
    count = known4.sum(0)
    mean = (p4 * known4[..., None]).sum(0) / np.maximum(count, 1)[..., None]
    top = np.where(known4, p4.argmax(3), -1)
    differs, unsure = (top != top[0]).any(0), 1 - mean.max(2)
    jump = np.abs(prior4.mean(0) - prior) > DEPTH_STEP * prior
    edge = np.abs(rgb4.mean(0) - rgb).sum(2)
    uncertainty = 2.0 * differs + jump + np.minimum(edge / 255, 1) + unsure
    uncertainty[~(differs | jump | (edge > COLOUR_STEP) | (unsure > UNSURE))] = 0
    between = (v % (step // 2) == 0) & (u % (step // 2) == 0) & ((v % step > 0) | (u % step > 0))
    some = between & (count > 0)
    mean_depth = (depth4 * known4).sum(0) / np.maximum(count, 1)
    return (
        np.where(some[..., None], mean, p),
        known | some,
        np.where(some, mean_depth, depth),
        np.where(between, uncertainty, 0),
    )


@pytest.mark.parametrize("step", [2, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (12, 16), (13, 19), (15, 18)])
@pytest.mark.parametrize("classes", [1, 3, 40])
def test_pixels_between_rays_hold_the_mean_of_those_round_them(step: int, size: tuple[int, int], classes: int):
    rng = np.random.default_rng(step + 10 * sum(size) + classes)
    p = rng.random((*size, classes), np.float32) ** 8
    p /= p.sum(2, keepdims=True)
    grid = np.zeros(size, bool)
    grid[::step, ::step] = True
    known = grid & (rng.random(size) < 0.8)
    p[~grid] = 0
    depth = np.where(known, 1 + rng.random(size, np.float32), 0).astype(np.float32)
    prior = (1 + rng.choice([0.01, 0.2]) * rng.random(size)).astype(np.float32)
    rgb = rng.integers(0, 40, (*size, 3), dtype=np.uint8)
    expected = filled(step, p, known, depth, prior, rgb)
    uncertainty = np.zeros(size, np.float32)
    lines = -(-size[0] // (step // 2))
    fill_between_rays(lines, step, p, known, depth, prior, rgb, uncertainty, DEPTH_STEP, COLOUR_STEP, UNSURE)
    for got, twin in zip((p, known, depth, uncertainty), expected, strict=True):
        np.testing.assert_allclose(got, twin, atol=1e-6)
