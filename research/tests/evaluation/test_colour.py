from __future__ import annotations

import cv2
import numpy as np
import pytest

from research.evaluation.colour import MAX_PSNR_DB, match_colours, psnr, ssim
from semantic_mapper.errors import ShapeError


def pictures(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:48, :64]
    truth = np.stack((x / 64, y / 48, 0.5 + 0.4 * np.sin(x / 5)), -1)
    return truth.astype(np.float32), (truth + noise * rng.standard_normal(truth.shape)).clip(0, 1).astype(np.float32)


def test_psnr_by_hand() -> None:
    truth = np.full((12, 12, 3), 0.5, np.float32)
    assert psnr(truth, truth + np.float32(0.1)) == pytest.approx(20, abs=1e-4)  # mean square error 0.01
    half = truth.copy()
    half[:6] += 0.2  # mean square error 0.02
    assert psnr(truth, half) == pytest.approx(-10 * np.log10(0.02), abs=1e-4)
    assert psnr(truth, truth) == MAX_PSNR_DB


def test_psnr_agrees_with_opencv(rng: np.random.Generator) -> None:
    truth, noisy = pictures(rng, 0.05)
    assert psnr(truth, noisy) == pytest.approx(cv2.PSNR(truth, noisy, 1.0), abs=1e-6)


def test_exposure_and_white_balance_are_taken_out(rng: np.random.Generator) -> None:
    truth, _ = pictures(rng, 0)
    darker = (0.1 + truth * np.array([0.4, 0.6, 0.5], np.float32)).astype(np.float32)
    assert psnr(truth, darker) < 15
    assert psnr(truth, match_colours(truth, darker)) > 80
    flat = np.full_like(truth, 0.2)
    np.testing.assert_allclose(match_colours(truth, flat), np.broadcast_to(truth.mean((0, 1)), truth.shape), atol=1e-5)


def test_matching_by_hand() -> None:
    truth, rendered = np.zeros((1, 4, 3), np.float32), np.zeros((1, 4, 3), np.float32)
    truth[0, :, 0], rendered[0, :, 0] = (0.2, 0.4, 0.2, 0.4), (0.1, 0.3, 0.3, 0.5)
    # Means 0.3 and 0.3; covariance 0.01, variance 0.02: gain 0.5.
    np.testing.assert_allclose(match_colours(truth, rendered)[0, :, 0], (0.2, 0.3, 0.3, 0.4), atol=1e-6)


def test_ssim_by_hand_where_nothing_varies() -> None:
    a, b = np.full((11, 11, 3), 0.4, np.float32), np.full((11, 11, 3), 0.8, np.float32)
    # No variance: what is left is the term for the means, (2 * 0.4 * 0.8 + C1) / (0.4^2 + 0.8^2 + C1).
    assert ssim(a, b) == pytest.approx((0.64 + 1e-4) / (0.8 + 1e-4), abs=1e-6)
    assert ssim(a, a) == pytest.approx(1)


def test_ssim_agrees_with_opencv_away_from_the_border(rng: np.random.Generator) -> None:
    for noise in (0.02, 0.1, 0.3):
        truth, noisy = pictures(rng, noise)
        _, similarity = cv2.quality.QualitySSIM_compute(truth * 255, noisy * 255)
        inner = np.asarray(similarity)[5:-5, 5:-5, :3]
        assert ssim(truth, noisy) == pytest.approx(float(inner.mean()), abs=1e-4)


def test_ssim_falls_with_noise_and_blur(rng: np.random.Generator) -> None:
    values = [ssim(*pictures(rng, noise)) for noise in (0.0, 0.02, 0.1, 0.4)]
    assert values == sorted(values, reverse=True) and values[0] == pytest.approx(1)


def test_pictures_that_cannot_be_compared_are_refused() -> None:
    small = np.zeros((10, 30, 3), np.float32)
    with pytest.raises(ShapeError, match="at least 11 pixels"):
        ssim(small, small)
    for compare in (psnr, ssim, match_colours):
        with pytest.raises(ShapeError, match="one shape"):
            compare(np.zeros((12, 12, 3), np.float32), np.zeros((12, 13, 3), np.float32))
