"""Lens models by the names that ROS, Kalibr, COLMAP, OpenSfM and nerfstudio give them, as OpenCV's two.

A lens is judged by its values: zeros at the end of the coefficients say nothing, and missing ones are zero.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import COEFFICIENTS, Bool, CameraIntrinsics, FisheyeIntrinsics, Float64

# Coefficients in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty.
_PINHOLE = (
    "", "none", "pinhole", "perspective", "opencv", "full_opencv", "plumb_bob", "radtan", "radial_tangential", "brown",
    "rational_polynomial", "thin_prism", "radial", "simple_radial", "simple_pinhole", "standard",
)  # fmt: skip
_FISHEYE = ("equidistant", "equi", "fisheye", "opencv_fisheye", "fisheye_opencv", "kannala_brandt", "kannala_brandt4")
# Other models of a pinhole camera, of which nothing is left where all coefficients are zero.
_ZERO_IS_PINHOLE = ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady", "division")

MAX_INVERSE_PX = 1e-6  # by which the ray of a pixel may miss it
_STEPS, _ROUNDS, _EXACT_PX = 16, 60, 1e-9  # from the middle to a pixel; rounds of a step at most, and its end
_FAR = np.tan(np.radians(65.0))  # to each side: a pinhole stretches what is beyond
_PARTS = 0.97 ** np.arange(100)  # of a view that are tried
_EDGE = 1e-4  # of an image's width and height, by which points of its border may miss it


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

    Exact to ``MAX_INVERSE_PX``; NaN for a pixel that the lens model gives to no ray, as beyond its fold.
    """
    # OpenCV's own inverse ends too early, or not at all, and a fisheye's stops at 90 degrees of the bent angle. This is
    # Newton's method in steps away from the middle, so that a ray from beyond a fold is never taken.
    slopes, centre = np.zeros((len(pixels), 2)), camera_matrix(lens)[:2, 2]
    if not len(pixels):
        return slopes
    for part in np.arange(1, _STEPS + 1) / _STEPS:
        for _ in range(_ROUNDS):
            seen, slant = _bend(slopes, lens)
            off = centre + part * (pixels - centre) - seen
            area = _area(slant)
            area[~(area > 0)] = np.nan  # at a fold
            if not (np.abs(off) > _EXACT_PX)[area > 0].any():
                break
            (x, y), ((xu, xv), (yu, yv)) = off.T, np.moveaxis(slant, 0, -1)
            slopes += np.stack((yv * x - xv * y, xu * y - yu * x), axis=1) / area[:, None]
    off = _bend(slopes, lens)[0] - pixels
    ahead = (slopes * (pixels - centre)).sum(axis=1) >= 0
    slopes[~(ahead & (np.linalg.norm(off, axis=1) <= MAX_INVERSE_PX) & _before_fold(slopes, lens))] = np.nan
    return slopes


def _before_fold(slopes: Float64, lens: CameraIntrinsics) -> Bool:
    """Whether pixels move on with the rays (N, 2) all the way from the middle, by equal parts of the angle: (N,)."""
    far = np.linalg.norm(slopes, axis=1, keepdims=True)
    part = np.tan(np.linspace(0, 1, 64)[:, None, None] * np.arctan(far)) / np.where(far > 0, far, 1.0)
    rising: Bool = _area(_bend((part * slopes).reshape(-1, 2), lens)[1]).reshape(64, -1) > 0
    return np.asarray(rising.all(axis=0))


def _bend(slopes: Float64, lens: CameraIntrinsics) -> tuple[Float64, Float64]:
    """Pixels (N, 2) of rays with slopes (N, 2), and by how much they move with these (N, 2, 2); NaN of NaN."""
    still, rays = np.zeros(3), _ahead(slopes)[:, None]
    project, shifts = (cv2.fisheye.projectPoints, 11) if isinstance(lens, FisheyeIntrinsics) else (cv2.projectPoints, 3)
    coefficients = np.array(lens.distortion or (0.0,) * 4, np.float64)
    pixels, slants = project(rays, still, still, camera_matrix(lens), coefficients)[:2]
    flat, moved = np.asarray(pixels, np.float64).reshape(-1, 2), np.asarray(slants, np.float64)
    return flat, moved.reshape(len(slopes), 2, -1)[..., shifts : shifts + 2]


def _area(slant: Float64) -> Float64:
    return slant[..., 0, 0] * slant[..., 1, 1] - slant[..., 0, 1] * slant[..., 1, 0]


def clear_view(lenses: Sequence[tuple[CameraIntrinsics, Float64]], width: int, height: int) -> CameraIntrinsics:
    """The widest pinhole camera, of a size in pixels, whose rays all lie in the images of all lenses.

    ``lenses`` have turns R_view_lens (3, 3) of their axes. Raises FrameError: they have next to nothing in common.
    """
    least, most = np.full(2, -_FAR), np.full(2, _FAR)  # slopes to the left and up, to the right and down
    for lens, R in lenses:
        rays = _ahead(undistort(_border(0, 0, lens.width - 1, lens.height - 1), lens)) @ R.T
        up, right, down, left = np.split(rays[:, :2] / rays[:, 2:], 4)  # NaN where the lens folds before its edge
        least = np.fmax(least, np.fmax.reduce((left[:, 0], up[:, 1]), axis=1))
        most = np.fmin(most, np.fmin.reduce((right[:, 0], down[:, 1]), axis=1))
    middle, half, lens = (least + most) / 2, (most - least) / 2, lenses[0][0]
    views = [(middle, half)]
    if not isinstance(lens, FisheyeIntrinsics):  # its edges may tell no shape: that of its own image, twice as wide
        own = (np.array((lens.width, lens.height)) - 1) / (lens.fx, lens.fy)
        middle, half = own / 2 - (lens.cx / lens.fx, lens.cy / lens.fy), own
    views += [(middle, part * half) for part in _PARTS]
    far = np.array((width - 1, height - 1)) / 2
    for middle, half in views:  # the first, but for lenses that fold
        rays = _ahead(_border(*(middle - half), *(middle + half)))
        if (half > 0).all() and all(_shows(shown, rays @ R) for shown, R in lenses):
            # The longer side of a fisheye reaches much farther.
            focal = np.full(2, (far / half).max()) if isinstance(lens, FisheyeIntrinsics) else far / half
            (fx, fy), (cx, cy) = focal.tolist(), (far - focal * middle).tolist()
            return CameraIntrinsics(fx, fy, cx, cy, width, height)
    raise FrameError("no ray lies in the whole of it")


def _border(left: float, up: float, right: float, down: float) -> Float64:
    """Points (4 N, 2) on the edges of a box: upper, right, lower, left."""
    corners = np.array(((left, up), (right, up), (right, down), (left, down)))
    return np.concatenate([np.linspace(*edge, 129) for edge in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def _ahead(slopes: Float64) -> Float64:
    return np.pad(slopes, ((0, 0), (0, 1)), constant_values=1.0)


def _shows(lens: CameraIntrinsics, rays: Float64) -> bool:
    """Whether all rays (N, 3) lie in the image, and before the fold of the lens."""
    slopes = rays[:, :2] / rays[:, 2:]
    pixels, _ = _bend(slopes, lens)
    inside = (np.abs(pixels / (np.array((lens.width, lens.height)) - 1) - 0.5) < 0.5 + _EDGE).all()
    return bool(inside and _before_fold(slopes, lens).all())
