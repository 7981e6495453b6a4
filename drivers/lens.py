"""Lens models by the names that ROS, Kalibr, COLMAP, OpenSfM and nerfstudio give them, as OpenCV's two.

A lens is judged by its values: zeros at the end of the coefficients say nothing, and missing ones are zero.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import COEFFICIENTS, CameraIntrinsics, FisheyeIntrinsics, Float64

# Coefficients in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty.
_PINHOLE = (
    "", "none", "pinhole", "perspective", "opencv", "full_opencv", "plumb_bob", "radtan", "radial_tangential", "brown",
    "rational_polynomial", "thin_prism", "radial", "simple_radial", "simple_pinhole", "standard",
)  # fmt: skip
_FISHEYE = ("equidistant", "equi", "fisheye", "opencv_fisheye", "fisheye_opencv", "kannala_brandt", "kannala_brandt4")
# Other models of a pinhole camera, of which nothing is left where all coefficients are zero.
_ZERO_IS_PINHOLE = ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady", "division")

MAX_HALF_VIEW = np.radians(65.0)  # to each side of what a fisheye's image is cut to: a pinhole stretches what is beyond
MAX_INVERSE_PX = 1e-6  # by which the ray of a pixel may miss it
_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
_THETAS = np.linspace(0.0, np.pi, 4096)


def is_fisheye_model(model: str) -> bool:
    """Whether a name is that of OpenCV's fisheye."""
    return _plain(model) in _FISHEYE


def lens_intrinsics(
    model: str, coefficients: Sequence[float], k: tuple[float, float, float, float], size: tuple[int, int]
) -> CameraIntrinsics:
    """Intrinsics of a camera whose lens has a model by name, with any number of coefficients in OpenCV's order.

    ``k``: fx fy cx cy; pixel centres are integers. Raises ConfigError: a model that is neither OpenCV's pinhole nor its
    fisheye, or more coefficients than it has. FrameError: see ``CameraIntrinsics``.
    """
    name = _plain(model)
    values = [float(value) for value in coefficients]
    while values and values[-1] == 0:
        values.pop()
    if name in ("", "none") and values:
        raise ConfigError(f"a lens has coefficients {tuple(values)} and no model: name it, such as plumb_bob")
    if name in _ZERO_IS_PINHOLE and not values:
        return CameraIntrinsics(*k, *size)
    if name in _PINHOLE and len(values) <= COEFFICIENTS[-1]:
        count = next(count for count in COEFFICIENTS if count >= len(values))
        return CameraIntrinsics(*k, *size, (*values, *[0.0] * (count - len(values))))
    if name in _FISHEYE and len(values) <= 4:
        return FisheyeIntrinsics(*k, *size, (*values, *[0.0] * (4 - len(values))))
    if name in _PINHOLE or name in _FISHEYE:
        raise ConfigError(f"lens model '{model}' with {len(values)} coefficients; it has fewer: calibrate again")
    raise ConfigError(
        f"lens model '{model}' is not undone, only OpenCV's pinhole (plumb_bob, radtan, rational_polynomial) and "
        "fisheye (equidistant): undistort the images first, or calibrate with one of these"
    )


def _plain(model: str) -> str:
    return model.strip().lower().replace("-", "_")


def undistort(pixels: Float64, lens: CameraIntrinsics) -> Float64:
    """(N, 2) pixels of an image with distortion -> slopes (N, 2) of their rays, x / z and y / z in the camera's axes.

    Raises FrameError: a pixel that the lens model gives to no ray (to within ``MAX_INVERSE_PX``).
    """
    if not len(pixels):
        return np.zeros((0, 2))
    K, coefficients, still = camera_matrix(lens), np.array(lens.distortion or (0.0,) * 4), np.zeros(3)
    # By default OpenCV ends after five rounds: pixels off at the corner of a usual lens.
    invert, project = getattr(cv2, "undistortPointsIter", cv2.undistortPoints), cv2.projectPoints  # of OpenCV 4
    if isinstance(lens, FisheyeIntrinsics):
        invert, project = cv2.fisheye.undistortPoints, cv2.fisheye.projectPoints
    slopes = np.asarray(invert(pixels[:, None], K, coefficients, R=None, P=None, criteria=_UNTIL), np.float64)
    rays = np.concatenate((slopes, np.ones((len(slopes), 1, 1))), axis=2)
    back, _ = project(rays, still, still, K, coefficients)
    off = np.linalg.norm(np.asarray(back).reshape(-1, 2) - pixels, axis=1)
    if not off.max() <= MAX_INVERSE_PX:  # NaN, too
        u, v = pixels[int(np.argmax(off))]
        raise FrameError(
            f"the lens distortion {list(lens.distortion)} gives pixel {u:.0f}, {v:.0f} of {lens.width}x{lens.height} "
            "to no ray; calibrate again, with a board in all corners of the image"
        )
    return slopes.reshape(-1, 2)


def ideal_fisheye_view(lens: FisheyeIntrinsics) -> CameraIntrinsics:
    """The pinhole camera of the same size whose image a fisheye's fills: square pixels, no wider than the lens sees.

    ``FrameError`` where none fits.
    """
    distance = _THETAS * (1 + np.polynomial.polynomial.polyval(_THETAS**2, (0.0, *lens.distortion)))
    rising = int(np.argmax(np.diff(distance, append=-1.0) <= 0)) + 1  # beyond its fold a polynomial means nothing

    def reach(pixels: float, focal: float) -> float:
        """How far to one side the lens sees, as a slope."""
        theta = np.interp(max(pixels, 0.0) / focal, distance[:rising], _THETAS[:rising])
        return float(np.tan(min(theta, MAX_HALF_VIEW)))

    left, right = reach(lens.cx, lens.fx), reach(lens.width - 1 - lens.cx, lens.fx)
    up, down = reach(lens.cy, lens.fy), reach(lens.height - 1 - lens.cy, lens.fy)
    seen = min(left + right, up + down) > 0
    focal = max((lens.width - 1) / (left + right), (lens.height - 1) / (up + down)) if seen else 0.0
    cx = (lens.width - 1) / 2 + focal * (left - right) / 2
    cy = (lens.height - 1) / 2 + focal * (up - down) / 2
    return CameraIntrinsics(focal, focal, cx, cy, lens.width, lens.height)
