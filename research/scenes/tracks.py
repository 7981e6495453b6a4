"""Ways of things that move in a room, where there is floor for them and a camera sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from research.scenes.primitives import Shape, rotation_z
from research.scenes.render import cast_view
from research.scenes.scene import Scene
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import Bool, CameraIntrinsics, Float64

FRAME_HZ = 15
_SPEED = (0.8, 1.2)  # of people, m/s
_WAY_M = (0.6, 4.0)  # from one end of a walk to the other
_TURN = 8  # frames to turn round
_PERSON_M = 0.27  # radius of what they need
_CAMERA_M = 0.5  # from their middle to the camera, at least
_PUSH_M, _PUSH_SPEED = (0.4, 1.0), 0.6
_SWING = (1.2, 1.7)  # of a door, radians
_SWING_FRAMES = 20
_FLAT_M, _HEAD_M = 0.07, 1.95  # what lies lower is walked on (a rug), what hangs higher is walked under
_DRAWS, _CANDIDATES = 1500, 60
_PROBE = CameraIntrinsics(fx=27.6, fy=27.6, cx=19.5, cy=14.5, width=40, height=30)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Where something is on the floor: xy (N, 2), yaw (N,), there (N,) bool; it needs ``radius``."""

    xy: Float64
    yaw: Float64
    there: Bool
    radius: float

    def poses(self) -> Float64:
        """(N, 4, 4) from the origin to where it is."""
        T = np.tile(np.eye(4), (len(self.xy), 1, 1))
        T[:, :3, :3] = [rotation_z(yaw) for yaw in self.yaw]
        T[:, :2, 3] = self.xy
        return T


class Walk:
    """To and fro for all frames, facing the way."""

    radius, way_m, height_m, camera_m = _PERSON_M, _WAY_M, 1.1, _CAMERA_M

    def __init__(self, rng: np.random.Generator, count: int, *, stops: bool) -> None:
        self._step_m = rng.uniform(*_SPEED) / FRAME_HZ
        self._stand = [int(rng.integers(_TURN, 3 * FRAME_HZ)) if stops else _TURN for _ in range(2)]
        self._phase, self._count = rng.uniform(), count

    def track(self, a: Float64, b: Float64) -> Track:
        """Between two places (2,)."""
        steps = int(np.ceil(np.linalg.norm(b - a) / self._step_m))
        ahead = float(np.arctan2(*(b - a)[::-1])) - np.pi / 2  # people face their y
        way, yaw = np.arange(steps) / steps, np.full(steps, ahead)
        ends = [np.minimum(np.arange(1, stand + 1) / _TURN, 1.0) * np.pi for stand in self._stand]
        along = np.concatenate((way, np.ones(len(ends[0])), 1 - way, np.zeros(len(ends[1]))))
        turn = np.concatenate((yaw, ahead + ends[0], yaw + np.pi, ahead + np.pi + ends[1]))
        index = (int(self._phase * len(along)) + np.arange(self._count)) % len(along)
        xy = a + along[index, None] * (b - a)
        return Track(xy, turn[index], np.ones(self._count, bool), self.radius)


class Push:
    """From one place to another in the middle of the frames."""

    way_m, height_m, camera_m = _PUSH_M, 0.5, 0.5

    def __init__(self, radius: float, rng: np.random.Generator, count: int) -> None:
        self.radius, self._count = radius, count
        self._start, self._yaw = int(count * rng.uniform(0.25, 0.5)), rng.uniform(0, 2 * np.pi)

    def track(self, a: Float64, b: Float64) -> Track:
        """Between two places (2,)."""
        frames = np.linalg.norm(b - a) / _PUSH_SPEED * FRAME_HZ
        along = np.clip((np.arange(self._count) - self._start) / frames, 0.0, 1.0)
        xy = a + along[:, None] * (b - a)
        return Track(xy, np.full(self._count, self._yaw), np.ones(self._count, bool), self.radius)


class Stay:
    """In one place, for a part of the frames."""

    way_m, height_m, camera_m = (0.0, 0.0), 0.2, 0.4

    def __init__(self, radius: float, rng: np.random.Generator, count: int) -> None:
        self.radius, frame = radius, np.arange(count)
        self._there = (frame >= int(count * rng.uniform(0.2, 0.35))) & (frame < int(count * rng.uniform(0.6, 0.75)))
        self._yaw = rng.uniform(0, 2 * np.pi)

    def track(self, a: Float64, b: Float64) -> Track:
        """Between two places (2,)."""
        count = len(self._there)
        return Track(np.tile(a, (count, 1)), np.full(count, self._yaw), self._there, self.radius)


@dataclass(slots=True, eq=False)
class Floor:
    """Where there is space, and what the camera sees of it."""

    scene: Scene
    poses: Float64
    rng: np.random.Generator
    tracks: list[Track] = field(default_factory=list["Track"])
    low: Float64 = field(init=False)  # (Q, 3) boxes round all that stands on the floor or on something on it
    high: Float64 = field(init=False)
    group: NDArray[np.int64] = field(init=False)  # (Q,) that they belong to
    depth: Float64 = field(init=False)  # (N, h, w) what the camera sees

    def __post_init__(self) -> None:
        low, high = self.scene.primitives.bounds()
        group = self.scene.primitives.group
        keep = (group > 1) & (low[:, 2] < _HEAD_M) & (high[:, 2] > _FLAT_M)
        self.low, self.high, self.group = low[keep], high[keep], group[keep]
        self.depth = np.array([cast_view(self.scene, _PROBE, T)[0] for T in self.poses])

    def best(self, motion: Walk | Push | Stay) -> Track | None:
        """Of some tracks on free floor, the one that the camera sees for longest, preferably a long one."""
        best, most = None, 0.0
        for a, b in self._ways(motion.radius, motion.way_m):
            track = motion.track(a, b)
            if not self._apart(track, motion.camera_m):
                continue
            seen = self.sees(np.column_stack((track.xy, np.full(len(track.xy), motion.height_m))))
            score = float((seen & track.there).mean()) * (1.0 + min(float(np.linalg.norm(b - a)), 2.0))
            if score > most:
                best, most = track, score
        return best

    def sees(self, points: Float64) -> Bool:
        """(N,) whether the camera sees a point (N, 3) in its frame, or would see it if something was there."""
        seen = np.zeros(len(points), bool)
        for k, (T, point) in enumerate(zip(self.poses, points, strict=True)):
            x, y, z = transform(invert_pose(T), point)
            if 0.5 < z < 6.0:
                u, v = round(_PROBE.fx * x / z + _PROBE.cx), round(_PROBE.fy * y / z + _PROBE.cy)
                inside = 0 <= u < _PROBE.width and 0 <= v < _PROBE.height
                seen[k] = inside and self.depth[k, v, u] > z - 0.2
        return seen

    def gap(self, xy: Float64, but: int = -1) -> Float64:
        """(M,) from points of the floor (M, 2) to what stands there, ``but`` one group, or to the walls."""
        low, high = self.low[self.group != but, :2], self.high[self.group != but, :2]
        away = np.maximum(np.maximum(low - xy[:, None], xy[:, None] - high), 0.0)
        wall = np.minimum(xy, np.array(self.scene.size_m[:2]) - xy).min(1)
        return np.minimum(np.linalg.norm(away, axis=-1).min(1), wall)

    def _ways(self, radius: float, way_m: tuple[float, float]) -> Iterator[tuple[Float64, Float64]]:
        """Straight ways from a free place to another."""
        ends = self.rng.uniform(0, self.scene.size_m[:2], (_DRAWS, 2))
        angle, length = self.rng.uniform(0, 2 * np.pi, _DRAWS), self.rng.uniform(*way_m, _DRAWS)
        found = 0
        for a, step in zip(ends, length[:, None] * np.column_stack((np.cos(angle), np.sin(angle))), strict=True):
            if found < _CANDIDATES and (self.gap(a + np.linspace(0, 1, 20)[:, None] * step) >= radius).all():
                found += 1
                yield a, a + step

    def _apart(self, track: Track, camera_m: float) -> bool:
        """From the camera, and from what moves already."""
        if (np.linalg.norm(track.xy - self.poses[:, :2, 3], axis=1) < camera_m)[track.there].any():
            return False
        return all(
            (np.linalg.norm(track.xy - t.xy, axis=1) >= track.radius + t.radius)[track.there & t.there].all()
            for t in self.tracks
        )


def open_door(floor: Floor) -> tuple[Bool, Float64] | None:
    """The leaf (P,) of a closed door that can swing into the room, and its motion (N, 4, 4); the floor that it needs is
    free no more. None where there is no such door, or the camera is in its way."""
    p, count = floor.scene.primitives, len(floor.poses)
    door = np.flatnonzero((p.label == ROOMS.id_of("door")) & (p.group > 1) & (p.shape == Shape.BOX))
    inside = np.all((p.center > 0) & (p.center < np.array(floor.scene.size_m)), axis=1)
    for k in door[inside[door] & (p.half[door, 0] > 0.35) & (p.half[door, 1] < 0.04) & (p.half[door, 2] > 0.9)]:
        own = (p.center - p.center[k]) @ p.rotation[k]  # P 3: x along the leaf, y into the room
        before = np.abs(own) < p.half[k] + np.array([0.0, 0.2, 0.0])
        leaf = (p.group == p.group[k]) & before.all(axis=1)
        side = own[leaf, 0][np.abs(own[leaf, 0]).argmax()]  # of the handle
        hinge = p.center[k] - p.rotation[k] @ np.array([np.copysign(p.half[k, 0], side), 0.0, 0.0])
        wide = 2 * (p.center[k] - hinge)[:2]
        sign = float(np.copysign(1.0, side))
        sweep = [hinge[:2] + rotation_z(sign * a)[:2, :2] @ wide for a in np.linspace(0.2, _SWING[1], 16)]
        low, high = np.min((hinge[:2], *sweep), axis=0), np.max((hinge[:2], *sweep), axis=0)
        free = _free_swing(floor, int(p.group[k]), hinge[:2], wide, sign)
        if free < 0.5:
            continue
        turns = _swing(floor, hinge, wide, sign * free)
        if turns is None:
            continue
        floor.low, floor.high = np.vstack((floor.low, (*low, 0.0))), np.vstack((floor.high, (*high, _HEAD_M)))
        floor.group = np.append(floor.group, p.group[k])
        T = np.tile(np.eye(4), (count, 1, 1))
        T[:, :3, :3] = [rotation_z(turn) for turn in turns]
        T[:, :3, 3] = hinge - T[:, :3, :3] @ hinge
        return leaf, T
    return None


def _free_swing(floor: Floor, door: int, hinge: Float64, wide: Float64, sign: float) -> float:
    """Radians by which the leaf of a door (number of its group) turns without touching anything."""
    most, angle, along = floor.rng.uniform(*_SWING), 0.1, np.linspace(0.3, 1.0, 12)[:, None]
    while angle < most and (floor.gap(hinge + along * (rotation_z(sign * angle)[:2, :2] @ wide), door) > 0.0).all():
        angle += 0.1
    return angle - 0.1


def _swing(floor: Floor, hinge: Float64, wide: Float64, turn: float) -> Float64 | None:
    """(N,) radians of a leaf that opens when the camera sees it, clear of the camera; None where it never can."""
    frame, count = np.arange(len(floor.poses)), len(floor.poses)
    best, most = None, 0
    for start in range(count // 4, max(count // 4, 2 * count // 3) + 1, 5):
        turns = turn * np.clip((frame - start) / _SWING_FRAMES, 0.0, 1.0)
        ways = np.array([rotation_z(t)[:2, :2] @ wide for t in turns])
        leaf = hinge[:2] + np.linspace(0, 1, 8)[:, None, None] * ways  # 8 N 2
        away = np.linalg.norm(leaf - floor.poses[:, :2, 3], axis=-1)  # 8 N
        if away[:, frame > start].min(initial=np.inf) < 0.4:
            continue
        middle = np.column_stack((leaf[5], np.full(count, 1.0)))
        seen = int(floor.sees(middle)[start : start + 2 * _SWING_FRAMES].sum())
        if seen > most:
            best, most = turns, seen
    return best
