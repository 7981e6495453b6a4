import dataclasses

import numpy as np
import pytest

from semantic_mapper.config import SamplingConfig
from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import Rays, Rendered
from semantic_mapper.fields.render import View, render_sparse_view, render_view
from semantic_mapper.labels import make_label_set
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(30.0, 30.0, 19.5, 14.5, 40, 30)
LABELS = make_label_set("two", ("left", "right"), ids=(1, 2), ignore_id=0)
SAMPLING = SamplingConfig()


@dataclasses.dataclass
class Halves:
    """Says "left" of rays to the left of ``border`` (pixels), sure; nothing of the rows above ``unknown_above``."""

    border: float = 17.0
    unknown_above: int = 0
    sure: float = 6.0
    rays: int = 0
    label_set = LABELS

    def render(self, rays: Rays, sources: None) -> Rendered:
        u = rays.direction[:, 0] / rays.direction[:, 2] * CAMERA.fx + CAMERA.cx
        v = rays.direction[:, 1] / rays.direction[:, 2] * CAMERA.fy + CAMERA.cy
        self.rays += len(u)
        logits = self.sure * np.stack((u < self.border, u >= self.border), 1).astype(np.float32)
        known, ones = v > self.unknown_above - 0.5, np.ones_like(u)
        return Rendered(logits, rays.prior_depth_m, ones, np.zeros((len(u), 3), np.float32), known)


PRIOR, GREY = np.full((30, 40), 2.0, np.float32), np.full((30, 40, 3), 90, np.uint8)


def sparse(field: Halves, prior: np.ndarray = PRIOR, fraction: float = 0.99, rgb: np.ndarray = GREY):
    return render_sparse_view(View(field, None, CAMERA, np.eye(4), prior, SAMPLING, 128), rgb, fraction)  # type: ignore[arg-type]


def dense(field: Halves):
    return render_view(View(field, None, CAMERA, np.eye(4), PRIOR, SAMPLING, 128))  # type: ignore[arg-type]


@pytest.mark.parametrize("border", [15.5, 16.5, 17.5, 18.5])
def test_a_border_between_classes_is_found_to_the_pixel_with_a_fifth_of_the_rays(border: float):
    field = Halves(border)
    p, known, depth, traced = sparse(field)
    expected, _, expected_depth = dense(Halves(border))
    np.testing.assert_array_equal(p.argmax(2), expected.argmax(2))
    np.testing.assert_allclose(p, expected, atol=1e-6)
    np.testing.assert_allclose(depth, expected_depth, atol=1e-6)
    assert known.all()
    assert traced.sum() == field.rays < 0.2 * 30 * 40
    p, known, _, _ = sparse(Halves(border, unknown_above=10), fraction=0.0)
    np.testing.assert_allclose(p[known].sum(1), 1, atol=1e-6)


def test_pixels_whose_depth_is_another_than_their_neighbours_have_rays_of_their_own():
    prior = PRIOR.copy()
    prior[:, 31] = 1.0  # a pole, one pixel wide, between the columns of every coarser grid
    _, _, depth, _ = sparse(Halves(), prior)
    np.testing.assert_array_equal(depth[:, 31], 1.0)
    np.testing.assert_array_equal(depth[:, 25], 2.0)


def test_the_fraction_is_a_limit_and_the_most_uncertain_go_first():
    prior = PRIOR.copy()
    prior[10] = 1.0
    needed = sparse(Halves(17.5))[3].sum()
    p, _, _, traced = sparse(Halves(17.5), prior, fraction=needed / 1200)
    assert traced.sum() == needed < sparse(Halves(17.5), prior)[3].sum()
    np.testing.assert_array_equal(p.argmax(2), dense(Halves(17.5))[0].argmax(2))
    assert sparse(Halves(), fraction=0.0)[3].sum() == 80


def test_images_of_another_size_than_the_view_are_refused():
    with pytest.raises(ShapeError, match="depth prior"):
        sparse(Halves(), np.ones((30, 20), np.float32))
    with pytest.raises(ShapeError, match="view rgb"):
        sparse(Halves(), rgb=np.zeros((60, 40, 3), np.uint8))
