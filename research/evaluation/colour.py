"""How near a rendered picture comes to the true one: PSNR and SSIM, whatever the exposure."""

from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.errors import ShapeError
from semantic_mapper.types import Float32, Float64

MAX_PSNR_DB = 100.0
SSIM_WINDOW = 11  # pixels a side of the Gaussian window
SSIM_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2  # for values in [0, 1]


def match_colours(truth: Float32, rendered: Float32) -> Float32:
    """The rendered picture with the gain and offset of each channel that bring it nearest to the true one.

    Exposure and white balance of the source images are not those of the truth, and nobody can render what no image
    shows; a picture that is off by them alone is right. Raises ShapeError: the shapes differ.

    Args:
        truth, rendered: (H, W, 3) float32 in [0, 1].

    Returns:
        (H, W, 3) float32 in [0, 1].
    """
    _check(truth, rendered)
    matched = np.empty_like(rendered)
    for channel in range(3):
        x, y = rendered[..., channel].astype(np.float64), truth[..., channel].astype(np.float64)
        spread = float(((x - x.mean()) ** 2).mean())
        gain = float(((x - x.mean()) * (y - y.mean())).mean()) / spread if spread > 0 else 0.0
        matched[..., channel] = np.clip(y.mean() + gain * (x - x.mean()), 0, 1)
    return matched


def psnr(truth: Float32, rendered: Float32) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels; at most 100 (identical pictures).

    Raises ShapeError: the shapes differ.

    Args:
        truth, rendered: (H, W, 3) float32 in [0, 1].
    """
    _check(truth, rendered)
    error = float(np.mean((truth.astype(np.float64) - rendered.astype(np.float64)) ** 2))
    return MAX_PSNR_DB if error <= 10 ** (-MAX_PSNR_DB / 10) else float(-10 * np.log10(error))


def ssim(truth: Float32, rendered: Float32) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian window of 11 pixels, sigma 1.5, mean over the colour channels.

    Only windows that lie wholly in the picture count, so that no rule for its border plays a part. Raises ShapeError:
    the shapes differ, or the picture is smaller than the window.

    Args:
        truth, rendered: (H, W, 3) float32 in [0, 1], at least 11 pixels a side.
    """
    _check(truth, rendered)
    if min(truth.shape[:2]) < SSIM_WINDOW:
        raise ShapeError(f"ssim needs pictures of at least {SSIM_WINDOW} pixels a side, got {truth.shape}")
    x, y = truth.astype(np.float64), rendered.astype(np.float64)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    var_x, var_y = _window_mean(x * x) - mean_x**2, _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    light = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * covariance + _C2) / (var_x + var_y + _C2)
    return float((light * structure).mean())


def _window_mean(x: Float64) -> Float64:
    """(H, W, 3) -> (H - 10, W - 10, 3)."""
    border = SSIM_WINDOW // 2
    blurred = cv2.GaussianBlur(x, (SSIM_WINDOW, SSIM_WINDOW), SSIM_SIGMA)
    return np.asarray(blurred, np.float64)[border:-border, border:-border]


def _check(truth: Float32, rendered: Float32) -> None:
    if truth.shape != rendered.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ShapeError(
            f"pictures to compare: expected two of one shape (H, W, 3), got {truth.shape} and {rendered.shape}"
        )
