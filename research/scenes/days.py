"""A home on two days: rooms side by side, and what was moved, taken away and brought between two visits of a robot.

What is moved are the pieces of ``make_room`` (groups of primitives) that a person can carry and on which nothing
stands. They stay upright and go to a free place on a floor or on a level top, of the same room or of another one. On
the second day lamps have other strengths and colours, and doors stand otherwise where nothing is in the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from research.scenes.building import BEYOND_M, room_cell
from research.scenes.camera import camera_path
from research.scenes.config import CameraPathConfig, NoiseConfig, RoomConfig
from research.scenes.materials import MaterialTable
from research.scenes.primitives import Primitives, Shape, rotation_z
from research.scenes.room import make_room
from research.scenes.scene import Lights, Scene, add_primitives, extremes, shadow_cubes
from research.scenes.sequence import RoomView, render_views
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics, Float64, Int64

TEMPLATES = ("kitchen", "living", "bedroom", "office", "bathroom")
MOVED, GONE, NEW = 12, 4, 4  # things of one day
BETWEEN = 5  # of the moved go to another room
FIXED = frozenset(
    (
        "wall floor ceiling door window curtain blinds picture counter bed bathtub toilet sink refrigerator floormat"
    ).split()
)
SIZE_M = (0.2, 1.4)  # diagonal of what is carried
LEAST_SHIFT_M, NUDGE_M = 0.3, 0.1
GAP_M = 0.04  # to what stands round a new place
TOP_M = (0.3, 1.3)  # heights of tops
SHELL = 6  # groups: floor, ceiling, walls
SWING = (0.4, 1.4)  # radians that the leaf of a door turns by
TRIES = 400

Kind = Literal["moved", "nudged", "swapped", "new", "gone"]


@dataclass(frozen=True, slots=True, eq=False)
class DayChange:
    """One true change.

    Args:
        kind: ``nudged`` is a move by ``NUDGE_M``; ``swapped``: of two identical things, each stands where the other
            was, which no picture tells.
        label: Class id.
        before, after: Low and high corner (2, 3), world metres; None where it is not there.
        rooms: Index of the room before and after.
    """

    kind: Kind
    label: int
    before: Float64 | None
    after: Float64 | None
    rooms: tuple[int | None, int | None]


@dataclass(frozen=True, slots=True, eq=False)
class Home:
    """Rooms on one day, each in its own axes, at ``offsets`` (R, 3) in the world. The robot's ``camera`` has one look
    (contrast, saturation, lens) in all rooms and on all days."""

    rooms: tuple[Scene, ...]
    offsets: Float64
    camera: int


def make_home(seed: int) -> Home:
    """The home of a seed: one room of each of ``TEMPLATES``."""
    rooms = tuple(make_room(5 * seed + k, RoomConfig(template=name)) for k, name in enumerate(TEMPLATES))
    offsets = np.array([room_cell(k, len(rooms))[0] + (BEYOND_M, BEYOND_M, 0) for k in range(len(rooms))])
    offsets[:, 2] = 0
    return Home(rooms, offsets, seed)


def visit(
    home: Home,
    seed: int,
    frames_a_room: int,
    intrinsics: CameraIntrinsics,
    noise: NoiseConfig | None,
    errors: Sequence[Float64] = (),
    step_m: float = 0.09,
) -> Iterator[tuple[int, RoomView]]:
    """The frames of one visit with their rooms; another ``seed`` begins elsewhere and goes another way.

    Args:
        home: As it is on that day.
        seed: Of the way and of the noise.
        frames_a_room: Of each room.
        intrinsics: Of the camera.
        noise: As of ``room_views``.
        errors: T (4, 4) for each room by which the poses of its frames are off, about the room's middle.
        step_m: Mean way between two frames.
    """
    for number, (scene, offset) in enumerate(zip(home.rooms, home.offsets, strict=True)):
        poses = camera_path(scene, frames_a_room, seed, CameraPathConfig(step_m=step_m, close_up=0.25))
        known = poses
        if len(errors):
            middle = np.eye(4)
            middle[:3, 3] = np.array(scene.size_m) / 2
            known = middle @ errors[number] @ np.linalg.inv(middle) @ poses
        of_room, scenes = 1_000_003 * seed + number, [scene] * len(poses)
        views = render_views(of_room, scenes, poses, intrinsics, noise=noise, frame_poses=known, camera=home.camera)
        for view in views:
            T, T_true = view.frame.T_world_camera.copy(), view.T_world_camera.copy()
            T[:3, 3] += offset
            T_true[:3, 3] += offset
            yield number, replace(view, frame=replace(view.frame, T_world_camera=T), T_world_camera=T_true)


def pose_errors(rng: np.random.Generator, rooms: int, shift_m: float = 0.02, turn_deg: float = 0.5) -> list[Float64]:
    """For each room a motion (4, 4) of exactly this length and angle, in any direction."""
    errors: list[Float64] = []
    for _ in range(rooms):
        shift, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
        K = np.cross(np.eye(3), axis)
        angle = np.radians(turn_deg)
        T = np.eye(4)
        T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
        T[:3, 3] = shift_m * shift
        errors.append(T)
    return errors


class _Movers:
    """Rooms that are being changed; a group that is carried away leaves its number unused."""

    def __init__(self, home: Home, rng: np.random.Generator) -> None:
        self.rooms, self.offsets, self.rng = list(home.rooms), home.offsets, rng
        self.used = [set[int]() for _ in home.rooms]

    def carried(self, room: int) -> list[int]:
        """Groups of a room that may be moved, in random order."""
        scene = self.rooms[room]
        p, size = scene.primitives, np.array(scene.size_m)
        low, high = p.bounds()
        fixed = {i for i, name in zip(ROOMS.ids, ROOMS.names, strict=True) if name in FIXED}
        found: list[int] = []
        for group in np.unique(p.group[p.group >= SHELL]).tolist():
            own = p.group == group
            a, b = low[own].min(axis=0), high[own].max(axis=0)
            labels = set(p.label[own].tolist())
            inside = (a >= -0.01).all() and (b <= size + 0.01).all()
            if group in self.used[room] or labels & fixed or len(labels) > 1 or not inside or a[2] > TOP_M[1]:
                continue
            if not SIZE_M[0] <= np.linalg.norm(b - a) <= SIZE_M[1] or min(b - a) < 0.04:
                continue
            above = ~own & (low[:, :2] < b[:2]).all(axis=1) & (high[:, :2] > a[:2]).all(axis=1)
            above &= (p.group >= SHELL) & (low[:, 2] > a[2] + 0.02) & (low[:, 2] < b[2] + 0.03)
            below = ~own & (low[:, :2] < b[:2]).all(axis=1) & (high[:, :2] > a[:2]).all(axis=1)
            below &= np.abs(high[:, 2] - a[2]) < 0.03
            if not above.any() and (below.any() or a[2] < 0.03):
                found.append(group)
        return self.rng.permutation(found).tolist()

    def box(self, room: int, group: int) -> Float64:
        """(2, 3) corners in the world."""
        p = self.rooms[room].primitives
        low, high = p.bounds()
        own = p.group == group
        return np.stack((low[own].min(axis=0), high[own].max(axis=0))) + self.offsets[room]

    def take(self, room: int, group: int) -> tuple[Primitives, MaterialTable]:
        """Carry a group away."""
        scene = self.rooms[room]
        own = scene.primitives.group == group
        self.rooms[room] = replace(scene, primitives=_rows(scene.primitives, ~own))
        return _rows(scene.primitives, own), scene.materials

    def put(self, room: int, thing: tuple[Primitives, MaterialTable], near: Float64 | None = None) -> int | None:
        """Stand a thing at a free place of a room, at ``NUDGE_M`` from ``near`` (3,) where that is given; its new
        group, or None where no place is found."""
        p, scene = thing[0], self.rooms[room]
        low, high = p.bounds()
        middle = np.append((low.min(axis=0) + high.max(axis=0))[:2] / 2, low[:, 2].min())
        centred = replace(p, center=p.center - middle)
        for _ in range(TRIES):
            angle = 0.0 if near is not None else float(self.rng.uniform(0, 2 * np.pi))
            turn = rotation_z(angle)
            turned = replace(centred, center=centred.center @ turn.T, rotation=turn @ centred.rotation)
            place = self._place(scene, turned, near)
            if place is not None:
                moved = replace(turned, center=turned.center + place)
                group = int(scene.primitives.group.max()) + 1
                added = replace(moved, instance=moved.instance * 0 + 1, group=moved.group * 0)
                self.rooms[room] = add_primitives(scene, added, thing[1])
                self.used[room].add(group)
                return group
        return None

    def _place(self, scene: Scene, thing: Primitives, near: Float64 | None) -> Float64 | None:
        """Where a thing with its foot at 0 may stand, of one draw; None where it may not."""
        p = scene.primitives
        low, high = p.bounds()
        a, b = (end.min(axis=0) if k == 0 else end.max(axis=0) for k, end in enumerate(thing.bounds()))
        flat = p.rotation[:, 2, 2] > 0.999
        top = flat & (p.shape == Shape.BOX) & ((high - low)[:, :2] > 0.3).all(axis=1) & (p.group >= SHELL)
        top &= (high[:, 2] > TOP_M[0]) & (high[:, 2] < TOP_M[1])
        tops = np.flatnonzero(top)
        if near is not None:
            angle = self.rng.uniform(0, 2 * np.pi)
            place = near + NUDGE_M * np.array((np.cos(angle), np.sin(angle), 0))
            support = -1
        elif len(tops) and np.linalg.norm(b - a) < 0.6 and self.rng.uniform() < 0.7:
            support = int(self.rng.choice(tops))
            room_for = low[support, :2] - a[:2] + 0.01, high[support, :2] - b[:2] - 0.01
            if (room_for[0] > room_for[1]).any():
                return None
            place = np.append(self.rng.uniform(*room_for), high[support, 2] + 1e-3)
        else:
            support = -1
            place = np.append(self.rng.uniform((0, 0), scene.size_m[:2]), 1e-3)
        a, b = a + place, b + place
        size = np.array(scene.size_m)
        if (a[:2] < 0.05).any() or (b[:2] > size[:2] - 0.05).any() or b[2] > size[2]:
            return None
        solid = (p.group >= SHELL) & (high[:, 2] > place[2] + 0.03)  # a rug is no obstacle
        gap = np.array((GAP_M, GAP_M, 0.0))
        meets = solid & (low < b + gap).all(axis=1) & (high > a - gap).all(axis=1)
        if near is not None:  # it stays on what it stood on
            foot = place[:2][None]
            held = (low[:, :2] < foot - 0.03).all(axis=1) & (high[:, :2] > foot + 0.03).all(axis=1)
            held &= np.abs(high[:, 2] - place[2]) < 0.03
            if not held.any():
                return None
        return None if meets.any() else place


def next_day(home: Home, seed: int, *, changes: bool = True) -> tuple[Home, list[DayChange]]:
    """The home on the next day and what has changed; without ``changes`` only its light has."""
    rng = np.random.default_rng((77, seed))
    movers, found = _Movers(home, rng), list[DayChange]()
    count = len(home.rooms)
    times: tuple[tuple[Kind, int], ...] = (("moved", MOVED - 1), ("nudged", 1), ("gone", GONE), ("new", NEW))
    plan: list[Kind] = [kind for kind, count in times for _ in range(count if changes else 0)]
    other = make_home(seed + 7919) if changes else home  # what is new comes from there
    foreign = _Movers(other, rng)
    for number, kind in enumerate(plan):
        for room in rng.permutation(count).tolist():
            source = foreign if kind == "new" else movers
            choice = source.carried(room)
            if not choice:
                continue
            group = choice[0]
            goal = (room + 1 + int(rng.integers(count - 1))) % count if kind == "moved" and number < BETWEEN else room
            before, label = source.box(room, group), _label(source.rooms[room], group)
            source.used[room].add(group)
            kept = source.rooms[room]
            thing = source.take(room, group)
            foot = np.append(before[:, :2].mean(axis=0), before[0, 2]) - movers.offsets[room]
            put = None if kind == "gone" else movers.put(goal, thing, foot if kind == "nudged" else None)
            if kind != "gone" and put is None:
                source.rooms[room] = kept
                continue
            after = None if put is None else movers.box(goal, put)
            stays = kind == "moved" and goal == room
            if stays and after is not None and np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) < LEAST_SHIFT_M:
                source.rooms[room] = kept
                continue
            was = None if kind == "new" else before
            found.append(
                DayChange(kind, label, was, after, (None if kind == "new" else room, None if put is None else goal))
            )
            break
    if changes:
        found += _swap(movers)
    leaves = np.random.default_rng((79, seed))
    opened = [_swing(scene, leaves) if changes else scene for scene in movers.rooms]
    return Home(tuple(_relit(scene, rng) for scene in opened), home.offsets, home.camera), found


def _swing(scene: Scene, rng: np.random.Generator) -> Scene:
    """Turn the leaf of each door to where nothing is in its way, a closed one into the room."""
    p = scene.primitives
    center, rotation = p.center.copy(), p.rotation.copy()
    for k in np.flatnonzero(
        (p.label == ROOMS.id_of("door")) & (p.half[:, 2] > 0.9) & (p.half[:, :2].max(axis=1) > 0.3)
    ):
        wide = int(np.argmax(p.half[k, :2]))
        own = (p.center - p.center[k]) @ p.rotation[k]
        reach = p.half[k] + 0.2 * (np.arange(3) == 1 - wide)
        leaf = np.flatnonzero((p.group == p.group[k]) & (np.abs(own) < reach).all(axis=1))
        lock = own[leaf, wide][np.abs(own[leaf, wide]).argmax()]  # where the handle is
        half = p.rotation[k][:2, wide] * np.copysign(p.half[k, wide], lock)
        hinge, along = p.center[k, :2] - half, np.linspace(0.3, 1.0, 12)[:, None]
        low, high = p.bounds()
        solid = (p.group != p.group[k]) & (low[:, 2] < 1.8) & (high[:, 2] > 0.1)
        most = rng.uniform(*SWING)
        for sign in rng.permutation((-1.0, 1.0)):
            angle, step = 0.0, 0.1
            while angle < most:
                xy = hinge + along @ (2 * half[None]) @ rotation_z(sign * (angle + step))[:2, :2].T
                if ((xy[:, None] > low[solid, :2] - GAP_M) & (xy[:, None] < high[solid, :2] + GAP_M)).all(axis=2).any():
                    break
                angle += step
            if angle >= SWING[0]:
                turn, pivot = rotation_z(sign * angle), np.append(hinge, 0.0)
                center[leaf] = (p.center[leaf] - pivot) @ turn.T + pivot
                rotation[leaf] = turn @ p.rotation[leaf]
                break
    return replace(scene, primitives=replace(p, center=center, rotation=rotation))


def _swap(movers: _Movers) -> list[DayChange]:
    """Swap two chairs that look the same; nothing is to be seen of it."""
    chair = ROOMS.ids[ROOMS.names.index("chair")]
    for room in range(len(movers.rooms)):
        chairs = [g for g in movers.carried(room) if _label(movers.rooms[room], g) == chair]
        for one in chairs:
            for two in chairs:
                boxes = movers.box(room, one), movers.box(room, two)
                p = movers.rooms[room].primitives
                a, b = (np.flatnonzero(p.group == g) for g in (one, two))
                if one < two and len(a) == len(b) and np.allclose(p.half[a], p.half[b]):
                    for field_ in (p.center, p.rotation):
                        field_[a], field_[b] = field_[b].copy(), field_[a].copy()
                    return [
                        DayChange("swapped", chair, boxes[0], boxes[1], (room, room)),
                        DayChange("swapped", chair, boxes[1], boxes[0], (room, room)),
                    ]
    return []


def _label(scene: Scene, group: int) -> int:
    return int(scene.primitives.label[scene.primitives.group == group][0])


def _rows(p: Primitives, chosen: Int64 | np.ndarray) -> Primitives:
    return Primitives(*(getattr(p, name)[chosen].copy() for name in Primitives.__dataclass_fields__))


def _relit(scene: Scene, rng: np.random.Generator) -> Scene:
    """Other strengths and colours of the lamps, and the shadows of what stands there now."""
    light = scene.lights
    strength = np.exp(rng.normal(0, 0.5, (len(light.color), 1))) * (1 + rng.uniform(-0.1, 0.1, (len(light.color), 3)))
    cubes = shadow_cubes(scene.primitives, light.position, light.shadow.shape[-1])
    lights = Lights(
        position=light.position,
        color=light.color * strength,
        shadow=cubes,
        shadow_low=extremes(cubes)[0],
        shadow_high=extremes(cubes)[1],
        softness=light.softness,
        ambient=light.ambient * rng.uniform(0.7, 1.2),
    )
    return replace(scene, lights=lights)
