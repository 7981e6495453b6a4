"""Rooms in which things move, with truth: people who walk, a chair that is pushed, a box that is put down and taken
away, a door that opens. The room and the camera's way are those of ``room_views`` of the same seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from research.scenes.camera import camera_path
from research.scenes.config import SUITE_VERSION, TRAIN_SEEDS, CameraPathConfig, NoiseConfig, RoomConfig
from research.scenes.furniture import FURNITURE
from research.scenes.materials import Palette
from research.scenes.people import make_person
from research.scenes.primitives import PERSON, Assembly, Primitives, pack, place_parts
from research.scenes.room import make_room
from research.scenes.scene import Scene, add_primitives
from research.scenes.sequence import RoomView, render_views
from research.scenes.tracks import FRAME_HZ, Floor, Push, Stay, Track, Walk, open_door
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import transform
from semantic_mapper.types import Bool, CameraIntrinsics, Float64, UInt8

MOST_PEOPLE = 3
_MOVING_STREAM = 6


@dataclass(frozen=True, slots=True, eq=False)
class MovingThing:
    """Something that moves as a whole.

    Args:
        name: "person", "chair", "box" or "door".
        primitives: (P,) bool, which of the scene's it is.
        T_world_rest: (N, 4, 4) from where it is in the scene to where it is in each frame.
        there: (N,) bool, whether it is in the room.
    """

    name: str
    primitives: Bool
    T_world_rest: Float64
    there: Bool

    def moves(self, last: int = FRAME_HZ) -> Bool:
        """(N,) whether it has moved, come or gone in the ``last`` frames up to each."""
        step = (self.T_world_rest[1:] != self.T_world_rest[:-1]).any((1, 2)) | (self.there[1:] != self.there[:-1])
        step = np.append(step[:1], step)
        return np.array([step[max(0, k + 1 - last) : k + 1].any() for k in range(len(step))], bool)


@dataclass(frozen=True, slots=True, eq=False)
class MovingRoom:
    """A room, a camera's way through it, and what moves there.

    Args:
        scene: Of all that is ever there; things that move are where ``MovingThing`` says.
        poses: (N, 4, 4) T_world_camera.
        things: In the order of their numbers.
    """

    scene: Scene
    poses: Float64
    things: tuple[MovingThing, ...]


@dataclass(frozen=True, slots=True, eq=False)
class MovingView:
    """One frame with its truth.

    Args:
        view: The frame and its exact depth.
        thing: (H, W) uint8 number of the thing that a pixel shows, from 1; 0 = of what never moves.
        moving: (H, W) bool, whether it moves now or has moved within the last second.
    """

    view: RoomView
    thing: UInt8
    moving: Bool


def make_moving_room(
    seed: int,
    count: int,
    *,
    people: int = 2,
    room: RoomConfig = RoomConfig(),
    path: CameraPathConfig = CameraPathConfig(),
) -> MovingRoom:
    """The room of ``seed`` with things that move for ``count`` frames; everything follows from the arguments.

    What finds no free floor is left out, and so is the door of a room that has none. What is added casts no shadow.
    Raises ConfigError: another number of people, or settings that contradict each other.

    Args:
        seed: Of the room, of the camera's way and of what moves.
        count: Frames.
        people: Who walk to and fro where the camera sees them, 0 to 3. The first turns at once at either end of the
            way, others may stand there for a while.
        room, path: As for ``room_views``; ``room.people`` and arms are not for this.
    """
    if not 0 <= people <= MOST_PEOPLE:
        raise ConfigError(f"moving room: people must be 0 to {MOST_PEOPLE}, got {people}")
    if room.people or room.variety:
        raise ConfigError("moving room: RoomConfig.people and RoomConfig.variety must be 0; ask for people by number")
    still = make_room(seed, room)
    poses = camera_path(still, count, seed, path)
    rng = np.random.default_rng((SUITE_VERSION, seed, _MOVING_STREAM))
    floor = Floor(still, poses, rng)
    door = open_door(floor)
    palette = Palette(rng, held_out=seed not in TRAIN_SEEDS)
    placed: list[tuple[str, Assembly, Track]] = []

    def place(name: str, assembly: Assembly, track: Track | None) -> None:
        if track is not None:
            floor.tracks.append(track)
            placed.append((name, assembly, track))

    for number in range(people):
        person = make_person(rng, palette, casts_shadow=False)
        place(PERSON, person, floor.best(Walk(rng, count, stops=number > 0)))
    chair, box = (_centred(FURNITURE[kind].make(rng, palette)) for kind in ("chair", "carton"))
    place("chair", chair, floor.best(Push(_radius(chair), rng, count)))
    place("box", box, floor.best(Stay(_radius(box), rng, count)))
    return _assemble(still, poses, palette, placed, door)


def moving_views(
    room: MovingRoom, intrinsics: CameraIntrinsics, *, noise: NoiseConfig | None = None
) -> Iterator[MovingView]:
    """The frames of a room in which things move, with the noise that ``room_views`` gives those of the still room."""
    number = np.zeros(int(room.scene.primitives.instance.max()) + 1, np.uint8)
    for index, thing in enumerate(room.things):
        number[room.scene.primitives.instance[thing.primitives]] = index + 1
    moves = np.array([np.zeros(len(room.poses), bool), *(thing.moves() for thing in room.things)])
    scenes = (moving_scene_at(room, k) for k in range(len(room.poses)))
    for k, view in enumerate(render_views(room.scene.seed, scenes, room.poses, intrinsics, noise=noise)):
        thing = number[view.rendered.instance]
        yield MovingView(view, thing, moves[:, k][thing])


def moving_scene_at(room: MovingRoom, frame: int) -> Scene:
    """The scene as it is in one frame: things are elsewhere, or not there."""
    p = room.scene.primitives
    center, rotation, keep = p.center.copy(), p.rotation.copy(), np.ones(len(p), bool)
    for thing in room.things:
        T, own = thing.T_world_rest[frame], thing.primitives
        center[own], rotation[own] = transform(T, p.center[own]), T[:3, :3] @ p.rotation[own]
        keep[own] = thing.there[frame]
    moved = replace(p, center=center, rotation=rotation)
    present = Primitives(**{f.name: getattr(moved, f.name)[keep] for f in fields(Primitives)})
    return replace(room.scene, primitives=present)


def _assemble(
    still: Scene,
    poses: Float64,
    palette: Palette,
    placed: list[tuple[str, Assembly, Track]],
    door: tuple[Bool, Float64] | None,
) -> MovingRoom:
    groups = [assembly.parts for _, assembly, _ in placed]
    scene = still
    if groups:
        scene = add_primitives(scene, pack(groups), palette.table())
    p, first = scene.primitives, int(still.primitives.group.max()) + 1
    things = [
        MovingThing(name, p.group == first + index, track.poses(), track.there)
        for index, (name, _, track) in enumerate(placed)
    ]
    if door is not None:  # the leaf is an instance of its own: its frame stays
        leaf = np.append(door[0], np.zeros(len(p) - len(door[0]), bool))
        instance = np.where(leaf, p.instance.max() + 1, p.instance).astype(p.instance.dtype)
        scene = replace(scene, primitives=replace(p, instance=instance))
        things.append(MovingThing("door", leaf, door[1], np.ones(len(poses), bool)))
    return MovingRoom(scene, poses, tuple(things))


def _centred(assembly: Assembly) -> Assembly:
    """With the middle of what it covers at the origin."""
    low, high = assembly.bounds()
    return replace(assembly, parts=place_parts(assembly, 0.0, np.append(-(low + high)[:2] / 2, 0.0)))


def _radius(assembly: Assembly) -> float:
    """Round the origin, of all that it covers."""
    low, high = assembly.bounds()
    return float(np.hypot(*np.maximum(np.abs(low), np.abs(high))[:2]))
