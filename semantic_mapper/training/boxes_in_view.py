"""Which boxes frames can see at all: the others are left out before a field is built, however many there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.panoptic import LOOSE_M
from semantic_mapper.fields.primitives import ALONE_NS, Primitive
from semantic_mapper.types import Bool, Float32, Float64, PosedFrame

PAIRS = 1 << 20  # of boxes and cameras that are looked at together


def boxes_in_view(boxes: Sequence[Primitive], frames: Sequence[PosedFrame]) -> Bool:
    """Which boxes (P,) may be in the image of a frame, none of those that are for certain (what hides them is ignored).

    A box is taken as the ball round it, and an image as the cone through its corners. Boxes that move are looked at
    where they are at the time of each frame.

    Args:
        boxes: P of them.
        frames: With rigid poses, at any size.

    Raises:
        ConfigError: no box may be in any image.
    """
    balls = [_ball(box) for box in boxes]
    centre = np.array([c for c, _ in balls]).reshape(-1, 3)
    radius = np.array([r for _, r in balls])
    still = np.array([not box.moves for box in boxes], np.bool_)
    cone = np.array([_half_angle(frame) for frame in frames])
    pose = np.array([frame.T_world_camera for frame in frames]).reshape(-1, 4, 4)
    seen = np.zeros(len(boxes), np.bool_)
    at = np.array([box.T_world_box for box in boxes]).reshape(-1, 4, 4)
    world = np.einsum("pij,pj->pi", at[:, :3, :3], centre) + at[:, :3, 3]
    part = max(PAIRS // max(len(frames), 1), 1)
    for chosen in np.split(np.flatnonzero(still), range(part, int(still.sum()), part)):
        seen[chosen] = _meets(world[chosen], radius[chosen, None], pose, cone).any(1)
    for number in np.flatnonzero(~still).tolist():
        seen[number] = _moving_meets(boxes[number], centre[number], radius[number], frames, cone)
    if len(boxes) and not seen.any():
        raise nothing_in_view(world, world, pose[:, :3, 3], moving=not still.all())
    return seen


def nothing_in_view(low: Float64, high: Float64, cameras: Float64 | Float32, moving: bool = False) -> ConfigError:
    """That no box is in view of any frame, with where boxes (P, 3) and cameras (F, 3) are."""
    times = ", and the stamps of those that move the log's, in nanoseconds" if moving else ""
    return ConfigError(
        f"no box is in view of any frame: boxes lie from {_metres(low.min(0))} to {_metres(high.max(0))}, cameras from "
        f"{_metres(cameras.min(0))} to {_metres(cameras.max(0))}. Are the boxes in the log's world frame{times}?"
    )


def _ball(box: Primitive) -> tuple[Float64, float]:
    """Centre (3,) in the box's axes and radius of a ball round it and what may still be of its class."""
    low, high = -box.size / 2, box.size / 2
    if box.vertices is not None:
        low, high = box.vertices.min(0), box.vertices.max(0)
    elif box.polygon is not None:
        low, high = (np.append(f(box.polygon, axis=0), z) for f, z in ((np.min, low[2]), (np.max, high[2])))
    return (low + high) / 2, float(np.linalg.norm((high - low) / 2 + LOOSE_M))


def _half_angle(frame: PosedFrame) -> float:
    """Of the cone round the optical axis that holds the image, radians."""
    k = frame.intrinsics
    x = max(k.cx + 0.5, k.width - 0.5 - k.cx) / k.fx
    y = max(k.cy + 0.5, k.height - 0.5 - k.cy) / k.fy
    return float(np.arctan(np.hypot(x, y)))


def _meets(centre: Float64, radius: Float64, pose: Float64, cone: Float64) -> Bool:
    """Which balls (P,) meet the cones of which cameras (F,): (P, F). ``radius`` (P, 1)."""
    away = centre[:, None] - pose[None, :, :3, 3]
    z = np.einsum("pfi,fi->pf", away, pose[:, :3, 2])
    distance = np.linalg.norm(away, axis=-1)
    angle = np.arccos(np.clip(z / np.maximum(distance, 1e-9), -1, 1))
    wide = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
    return (distance <= radius) | (angle <= cone + wide)


def _moving_meets(box: Primitive, centre: Float64, radius: float, frames: Sequence[PosedFrame], cone: Float64) -> bool:
    assert box.stamps is not None
    times = [t for t, _ in box.stamps]
    margin = max((max(times) - min(times)) // 2, ALONE_NS)
    for frame, angle in zip(frames, cone, strict=True):
        if not min(times) - margin <= frame.stamp_ns <= max(times) + margin:
            continue
        pose = box.pose_at(frame.stamp_ns)
        if pose is None:
            continue
        world = pose[:3, :3] @ centre + pose[:3, 3]
        camera = np.asarray(frame.T_world_camera, np.float64)[None]
        if _meets(world[None], np.array([[radius]]), camera, np.array([angle])).any():
            return True
    return False


def _metres(xyz: Float64 | Float32) -> str:
    return "(" + ", ".join(f"{x:.2f}" for x in xyz) + ") m"
