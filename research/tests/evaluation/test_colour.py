from __future__ import annotations

import cv2
import numpy as np
import pytest

from research.evaluation.colour import MAX_PSNR_DB, match_colours, psnr, ssim


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


def test_ssim_agrees_with_opencv_away_from_the_border(rng: np.random.Generator) -> None:
    for noise in (0.02, 0.1, 0.3):
        truth, noisy = pictures(rng, noise)
        _, similarity = cv2.quality.QualitySSIM_compute(truth * 255, noisy * 255)
        inner = np.asarray(similarity)[5:-5, 5:-5, :3]
        assert ssim(truth, noisy) == pytest.approx(float(inner.mean()), abs=1e-4)
