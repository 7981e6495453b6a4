"""Draw a point cloud into a picture on the CPU: parallel projection, z-buffer, shading from the depth buffer."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.types import Float32, Float64, UInt8

SUPERSAMPLING = 2  # pixels drawn a side for each pixel of the picture
MAX_SPLAT = 13  # largest side of a splat, drawn pixels
COLUMN_M = 0.12  # side of the upright columns in which walls are looked for
VIEW_DEG = 55.0  # vertical field of view of ``seen_from``, as of Rerun's viewer
NEAREST_M = 0.05  # nothing nearer is in a picture
EDGE_STRENGTH = 1.1  # of the shading


def draw_points(
    xyz_view: Float64,
    colors: UInt8,
    size: tuple[int, int],
    background: tuple[int, int, int],
    *,
    camera: tuple[Float64, float] | None = None,
) -> tuple[UInt8, float]:
    """Draw points in parallel projection, fitted into the picture unless a camera is given.

    Args:
        xyz_view: (N, 3) metres: x to the right, y down, z away from the viewer.
        colors: (N, 3) uint8.
        size: (width, height) of the picture.
        background: (r, g, b).
        camera: The x and y (2,) of the picture's centre and pixels a metre, to draw several maps alike.

    Returns:
        (H, W, 3) uint8 picture and its scale in pixels a metre.
    """
    width, height = size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING
    canvas = np.full((height, width, 3), background, np.uint8)
    if not len(xyz_view):
        return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.uint8), 1.0
    centre, scale = fitted(xyz_view, size) if camera is None else camera
    scale *= SUPERSAMPLING
    pixel = np.floor((xyz_view[:, :2] - centre) * scale + (width / 2, height / 2)).astype(np.int64)
    nearest, depth = _z_buffer(pixel, xyz_view[:, 2], width, height)
    side = int(np.clip(np.ceil(point_spacing(xyz_view) * scale * 1.1), 1, MAX_SPLAT))
    nearest, depth = _grow(nearest, depth, side)
    hit = nearest >= 0
    shade = _edge_shading(depth, hit, scale)
    canvas[hit] = np.clip(colors[nearest[hit]] * shade[hit][:, None], 0, 255).astype(np.uint8)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.uint8), scale / SUPERSAMPLING


def fitted(xyz_view: Float64, size: tuple[int, int]) -> tuple[Float64, float]:
    """The ``camera`` of ``draw_points`` that fits points (N, 3), N > 0, into a picture (width, height)."""
    low, high = np.percentile(xyz_view[:, :2], (0.1, 99.9), axis=0)
    extent = np.maximum(high - low, 0.1) * 1.04 + 0.05
    return (low + high) / 2, float(min(size[0] / extent[0], size[1] / extent[1]))


def from_above(xyz_upright: Float64) -> Float64:
    """View coordinates (N, 3) of a look straight down on upright points (z up)."""
    return xyz_upright * (1.0, -1.0, -1.0)


def from_angle(xyz_upright: Float64, azimuth: float, elevation: float) -> Float64:
    """View coordinates (N, 3) of a look at upright points (z up) from a direction, in radians."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    right = np.array((-sa, ca, 0.0))
    towards_viewer = np.array((ca * ce, sa * ce, se))
    return xyz_upright @ np.stack((right, np.cross(right, towards_viewer), -towards_viewer)).T


def seen_from(xyz: Float64, position: Float64, target: Float64, up: Float64) -> NDArray[np.bool_]:
    """Which points (N, 3) a viewer sees: in his picture, and behind no other. All in metres of one world.

    The picture is coarse, so that points a few centimetres apart stand for a closed surface.

    Args:
        xyz: Points of surfaces.
        position, target: (3,) where he is, and where he looks.
        up: (3,) unit vector, not along his view.

    Returns:
        (N,) bool.
    """
    width, height = 64, 48
    focal = height / 2 / np.tan(np.deg2rad(VIEW_DEG) / 2)
    forward = (target - position) / max(float(np.linalg.norm(target - position)), 1e-6)
    right = np.cross(forward, up)
    right /= max(float(np.linalg.norm(right)), 1e-6)
    view = (xyz - position) @ np.stack((right, np.cross(forward, right), forward)).T
    ahead = np.flatnonzero(view[:, 2] > NEAREST_M)
    seen = np.zeros(len(xyz), np.bool_)
    if not len(ahead):
        return seen
    z = view[ahead, 2]
    pixel = np.floor(focal * view[ahead, :2] / z[:, None] + (width / 2, height / 2)).astype(np.int64)
    _, depth = _grow(*_z_buffer(pixel, z, width, height), 3)
    inside = ((pixel >= 0) & (pixel < (width, height))).all(axis=1)
    pixel, z, ahead = pixel[inside], z[inside], ahead[inside]
    seen[ahead] = z <= depth[pixel[:, 1], pixel[:, 0]] * 1.05 + 0.1
    return seen


def hides_the_room(xyz_upright: Float64, azimuth: float) -> NDArray[np.bool_]:
    """Which points of tall things stand in front and would hide the rest from a viewer at ``azimuth``.

    Leaving them out opens the map like a doll's house: walls, and what leans on them, on the viewer's side.

    Args:
        xyz_upright: (N, 3) metres, z up.
        azimuth: Direction of the viewer in the x-y plane, radians.

    Returns:
        (N,) bool; never the floor.
    """
    towards = np.array((np.cos(azimuth), np.sin(azimuth)))
    low, high = np.percentile(xyz_upright[:, 2], (2, 99)) if len(xyz_upright) else (0.0, 0.0)
    cells = np.floor(xyz_upright[:, :2] / COLUMN_M).astype(np.int64)
    columns, column = np.unique(cells, axis=0, return_inverse=True)
    column = column.ravel()
    top = np.full(len(columns), -np.inf)
    np.maximum.at(top, column, xyz_upright[:, 2])
    tall = top - low > 0.6 * (high - low)
    centre = (columns + 0.5) * COLUMN_M
    along = (centre - centre.sum(axis=0) / max(len(centre), 1)) @ towards
    # Of the tall columns in one line of sight, those of the front one's thickness hide what is behind them.
    line = np.floor(centre @ (-towards[1], towards[0]) / COLUMN_M).astype(np.int64)
    line -= line.min(initial=0)
    front = np.full(line.max(initial=0) + 1, -np.inf)
    np.maximum.at(front, line[tall], along[tall])
    hiding = tall & (along > front[line] - 2.5 * COLUMN_M) & (along > 0)
    return hiding[column] & (xyz_upright[:, 2] > low + 0.1)


def _z_buffer(pixel: NDArray[np.int64], z: Float64, width: int, height: int) -> tuple[NDArray[np.int64], Float32]:
    """Index (H, W) of the nearest point a pixel, -1 where none, and its z, infinite where none."""
    inside = np.flatnonzero(((pixel >= 0) & (pixel < (width, height))).all(axis=1))
    order = inside[np.argsort(-z[inside], kind="stable")]  # far to near: the last one written stays
    nearest = np.full(height * width, -1, np.int64)
    nearest[pixel[order, 1] * width + pixel[order, 0]] = order
    depth = np.where(nearest >= 0, z[nearest], np.inf).astype(np.float32)
    return nearest.reshape(height, width), depth.reshape(height, width)


def _grow(nearest: NDArray[np.int64], depth: Float32, side: int) -> tuple[NDArray[np.int64], Float32]:
    """Make every point a square of ``side`` pixels; the nearest one wins. First along rows, then along columns."""
    for axis in (1, 0):
        grown, grown_depth = nearest.copy(), depth.copy()
        for shift in range(-(side // 2), side - side // 2):
            to, of = [slice(None), slice(None)], [slice(None), slice(None)]
            to[axis] = slice(max(shift, 0), depth.shape[axis] + min(shift, 0))
            of[axis] = slice(max(-shift, 0), depth.shape[axis] + min(-shift, 0))
            closer = depth[tuple(of)] < grown_depth[tuple(to)]
            np.copyto(grown_depth[tuple(to)], depth[tuple(of)], where=closer)
            np.copyto(grown[tuple(to)], nearest[tuple(of)], where=closer)
        nearest, depth = grown, grown_depth
    return nearest, depth


def _edge_shading(depth: Float32, hit: NDArray[np.bool_], scale: float) -> Float32:
    """Eye-dome lighting: a pixel is darker the more its surroundings stand in front of it. (H, W), 1 = unshaded."""
    total = np.zeros_like(depth)
    filled = np.where(hit, depth, np.float32(np.nanmax(depth[hit]) + 0.05))
    for radius, weight in ((2, 1.0), (5, 0.6), (11, 0.4)):
        reach = radius / scale  # metres on the picture: a slope of 45 degrees darkens no more than by its fraction
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)):
            shift = np.array(((1, 0, radius * dx), (0, 1, radius * dy)), np.float32)
            shifted = cv2.warpAffine(
                filled, shift, filled.shape[::-1], flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
            in_front = (filled - shifted) / np.float32(6 * reach + 0.05)
            total += np.float32(weight / 8) * np.clip(in_front, 0, 1)
    return np.exp(-EDGE_STRENGTH * total).astype(np.float32)


def point_spacing(xyz: Float64) -> float:
    """Typical distance of a point to its fourth neighbour, metres: the pitch of a surface sampled on a grid."""
    if len(xyz) < 5:
        return 0.05
    from scipy.spatial import KDTree  # a machine that only trains and renders has no SciPy

    asking = xyz[:: max(1, len(xyz) // 500)]
    distances, _ = KDTree(xyz).query(asking, k=5)
    return float(np.percentile(distances[:, 4], 75))


def open_side(xyz_upright: Float64, elevation: float) -> float:
    """Azimuth of the corner from which most of upright points (N, 3) is seen, at an elevation, in radians."""
    if not len(xyz_upright):
        return 0.0
    step = max(1, len(xyz_upright) // 60_000)
    few = xyz_upright[::step]
    low_half = few[:, 2] < np.percentile(few[:, 2], 60)  # furniture and floor count, walls in front of them do not
    marks = np.where(low_half[:, None], np.uint8(255), np.uint8(0)) * np.ones((1, 3), np.uint8)
    best, most = 0.0, -1.0
    for degrees in (35, 55, 125, 145, 215, 235, 305, 325):
        azimuth = float(np.deg2rad(degrees))
        seen = ~hides_the_room(few, azimuth)
        picture, _ = draw_points(from_angle(few[seen], azimuth, elevation), marks[seen], (160, 120), (0, 0, 0))
        visible = float((picture[..., 0] > 60).mean())
        if visible > most:
            best, most = azimuth, visible
    return best
