"""Which way is up in a map, and how its walls run: so that pictures of it stand straight, whatever the world frame."""

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import turn_onto
from semantic_mapper.types import Float32, Float64

SAMPLE = 20_000  # points that the searches look at
BIN_M = 0.02  # of the histograms whose sharpness is measured
TILT_DEG = 10.0  # how far the refinement may turn the first guess
# Mean square of the level axes' second direction: a camera that turned about 6 degrees either way; and how many times
# that of the third, its roll.
MIN_TURN, MIN_TURN_TO_ROLL = 0.01, 2.0
SLAB_M = 0.15  # thickness within which a ceiling lies
CELL_M = 0.1  # of the floor plan
SNAP_DEG = 0.5  # nearer to an axis of the world than the search can tell apart: it is that axis
ROOF_SHARE = 0.04  # of the floor plan, from which on it is worth to cut


def camera_up(T_world_camera: Float64) -> Float64:
    """First guess of up (3,) in the world from the poses (N, 4, 4) of a camera that is held without much roll.

    The x axes of such a camera lie level, so up is what is square to them; where it never turned enough for that to
    be clear, the mean of its image-up directions. ShapeError without a pose.
    """
    if T_world_camera.ndim != 3 or T_world_camera.shape[1:] != (4, 4) or not len(T_world_camera):
        raise ShapeError(f"T_world_camera: expected shape (N, 4, 4) with N > 0, got {T_world_camera.shape}")
    image_up = -T_world_camera[:, :3, 1].mean(axis=0)
    level = T_world_camera[:, :3, 0]
    spread, axes = np.linalg.eigh(level.T @ level / len(level))
    if spread[1] < max(MIN_TURN, MIN_TURN_TO_ROLL * spread[0]):
        return image_up / np.linalg.norm(image_up)
    return axes[:, 0] if axes[:, 0] @ image_up > 0 else -axes[:, 0]


def upright_rotation(xyz: Float32 | Float64, up: Float64 | None = None) -> Float64:
    """Rotation ``R_upright_world`` after which z is up and most walls run along x or y, the longer side along x.

    Floors, tables and ceilings make the histogram of heights sharp, walls those of x and y: the rotation is the one
    that makes them sharpest, of points (N, 3) in metres, N may be 0. ``up`` (3,) is a rough direction: ten degrees off
    is corrected, and so is any error up to 45 degrees where the truth is an axis of the world; None tries the six axes.
    Deterministic; the identity where there are no points and no ``up``. Raises ShapeError: ``xyz`` is not (N, 3), or
    ``up`` has no direction.
    """
    if up is not None and not np.linalg.norm(up) > 0:
        raise ShapeError(f"up: expected a direction (3,), got {up}")
    points = _sample(xyz)
    if len(points) < 10:
        return _rotation_to_z(up) if up is not None else np.eye(3)
    guesses = [_axis_up(points)]
    if up is not None:  # and axes of the world within 45 degrees: most recordings have one of them along gravity
        axes = np.concatenate((np.eye(3), -np.eye(3)))
        guesses = [up / np.linalg.norm(up), *axes[axes @ up > np.cos(np.pi / 4) * np.linalg.norm(up)]]
    refined = [_refine_tilt(points, _rotation_to_z(guess)) for guess in guesses]
    R = _align_walls(points, min(refined, key=lambda turned: _spread(points @ turned[2])))
    x, y, _ = np.ptp(points @ R.T, axis=0)
    return R if x >= y else _turn(np.pi / 2) @ R


def find_upright(xyz: Float32 | Float64, up: Float64 | None = None) -> Float64:
    """Unit vector up (3,) in the world, found as by ``upright_rotation``; an axis of the world where it is so near."""
    found = upright_rotation(xyz, up)[2]
    axis = np.eye(3)[int(np.abs(found).argmax())] * np.sign(found[np.abs(found).argmax()])
    return axis if found @ axis > np.cos(np.deg2rad(SNAP_DEG)) else found


def plan_rotation(xyz: Float32 | Float64, up: Float64 | None = None) -> Float64:
    """Rotation (3, 3) from the world to the frame of an exported floor plan (``mapping.floor_plan``): z is up, x and
    y are those of the world where its z is up, too. Arguments and errors are those of ``upright_rotation``."""
    return turn_onto(find_upright(xyz, up), np.array((0.0, 0.0, 1.0)))


def ceiling_height(xyz_upright: Float32 | Float64) -> float | None:
    """Height in metres under which to cut a map (N, 3), z up, open so that one can look in: just below its ceiling.

    A ceiling is what lies high up with nothing close under it; a wall goes on below. ``None`` where nothing in the
    upper third roofs over a 25th of the floor plan.
    """
    points = _sample(xyz_upright)
    if len(points) < 10:
        return None
    z = points[:, 2]
    low, high = np.percentile(z, (1, 99.5))
    _, cell = np.unique(np.floor(points[:, :2] / CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    plan = int(cell.max()) + 1

    def holding(bottom: float, top: float) -> NDArray[np.bool_]:
        return np.bincount(cell[(z > bottom) & (z <= top)], minlength=plan) > 0

    top = float(high) + 0.02
    while top - SLAB_M > low + 0.62 * (high - low):
        bottom = top - SLAB_M
        roof = holding(bottom, top) & ~holding(bottom - 3 * SLAB_M, bottom)
        if roof.sum() >= ROOF_SHARE * plan:
            return bottom
        top -= 0.02
    return None


def _sample(xyz: Float32 | Float64) -> Float64:
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ShapeError(f"xyz: expected shape (N, 3), got {xyz.shape}")
    step = max(1, len(xyz) // SAMPLE)
    return xyz[::step].astype(np.float64)


def _rotation_to_z(up: Float64) -> Float64:
    z = up / np.linalg.norm(up)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    return np.stack((x, np.cross(z, x), z))


def _axis_up(points: Float64) -> Float64:
    """The axis along which the points form the sharpest layers, pointing away from the fullest layer (the floor)."""
    axis = min((2, 1, 0), key=lambda i: _spread(points[:, i]))
    counts, edges = np.histogram(points[:, axis], bins=np.arange(*_bounds(points[:, axis]), BIN_M))
    fullest = edges[int(np.argmax(counts))]
    sign = 1.0 if fullest <= np.median(points[:, axis]) else -1.0
    return np.eye(3)[axis] * sign


def _refine_tilt(points: Float64, R: Float64) -> Float64:
    """Turn about x and y, coarse to fine, to where the heights are sharpest."""
    step = np.deg2rad(TILT_DEG) / 3
    for _ in range(4):
        turns = [_tilt(a * step, b * step) @ R for a in range(-3, 4) for b in range(-3, 4)]
        R = min(turns, key=lambda turned: _spread(points @ turned[2]))
        step /= 3
    return R


def _align_walls(points: Float64, R: Float64) -> Float64:
    def wall_spread(angle: float) -> float:
        turned = points @ (_turn(angle) @ R)[:2].T
        return _spread(turned[:, 0]) + _spread(turned[:, 1])

    best, step = np.pi / 4, np.pi / 90
    candidates = np.arange(0, np.pi / 2, step)
    for _ in range(3):
        best = float(min(candidates, key=wall_spread))
        candidates = best + np.linspace(-1, 1, 9) * step
        step /= 4
    return _turn(best) @ R


def _spread(values: Float64) -> float:
    """Minus the chance that two values share a bin: small where many lie in a few sharp layers."""
    counts = np.histogram(values, bins=np.arange(*_bounds(values), BIN_M))[0]
    p = counts / counts.sum()
    return -float((p * p).sum())


def _bounds(values: Float64) -> tuple[float, float]:
    return float(values.min()) - BIN_M / 2, float(values.max()) + 2 * BIN_M  # a layer at the edge is not split


def _turn(angle: float) -> Float64:
    c, s = np.cos(angle), np.sin(angle)
    return np.array(((c, -s, 0), (s, c, 0), (0, 0, 1)))


def _tilt(a: float, b: float) -> Float64:
    ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    return np.array(((cb, 0, sb), (sa * sb, ca, -sa * cb), (-ca * sb, sa, ca * cb)))
