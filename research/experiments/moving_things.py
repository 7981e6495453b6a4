"""How well a mapper keeps out of its map what moves: people who walk, a pushed chair, a box that comes and goes, doors.

``rooms`` maps generated rooms in which these move, and the same rooms without them, with the camera's way and noise the
same. A log is mapped as it is and with a cylinder of the size of a person that walks through its depth and colour.
Each is mapped with ``moving`` off, on (``motion``, ``classes``, ``both``), and as by a mapper that knows the ``truth``.
The field knows the true class of each pixel of the frame, "person" too; with ``--weights`` it is S-Ray.

Example: python -m research.experiments.moving_things rooms --modes off motion truth
         python -m research.experiments.moving_things kitchen.mcap
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from research.experiments.put_things import Thing, place_thing, sees_through, with_thing
from research.scenes import TEST_SEEDS, CameraPathConfig, NoiseConfig, RoomConfig, room_views
from research.scenes.moving import make_moving_room, moving_views
from research.scenes.primitives import PERSON
from semantic_mapper.config import MapperConfig, SamplingConfig, convert_config
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.fields.base import CHUNK, Rays, Rendered, WorkingView
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

FIRST = 15  # frames before answers count: the map has to see free space first
NEAR_M, APART_M = 0.05, 0.06  # a ghost is this near to where a thing was, and this far from all that stays
BEFORE, EVERY = 45, 3  # "seen free" is what one of so many frames before, of every third, looked through
HIDDEN = 0.1  # fraction of the pictures of a log that the one who walks hides
MOST_FRAMES, SLOW_FRAMES = 1000, 30  # with pose noise, at most; time constant of a drift
CELL_M, STRIDE = 0.02, 3  # of the true surfaces: a point a cell, of every third pixel
LEAST_DEPTH_M = 0.1
ROOM, PATH = RoomConfig(min_side_m=4.5, max_side_m=7.0), CameraPathConfig(step_m=0.03)
MODES = {
    "off": (False, False),
    "motion": (True, False),
    "classes": (False, True),
    "both": (True, True),
    "truth": (False, False),
}


class Seen(NamedTuple):
    """One frame with truth.

    Args:
        frame: What the mapper gets.
        depth_m: (H, W) exact; 0 = unknown.
        thing: (H, W) number of the thing that a pixel shows, from 1; 0 = of what never moves.
        moving: (H, W) whether it moves or has moved within the last second.
    """

    frame: PosedFrame
    depth_m: Float32
    thing: UInt8
    moving: Bool


class Stretch(NamedTuple):
    """Frames with things that move, and the same without.

    Args:
        name: Of the room or log.
        labels: Of the frames.
        things: Their names, in the order of their numbers.
        stays: (things, N) whether each is in a frame where it stays at the end.
        moving, still: N frames each, rendered as they are requested.
    """

    name: str
    labels: LabelSet
    things: list[str]
    stays: Bool
    moving: Iterator[Seen]
    still: Iterator[Seen]


class NoView:
    """What ``FrameLabels`` keeps of a view."""

    size = (), ()

    def at(self, T_world_camera: Float64) -> NoView:
        """The same from anywhere."""
        return self


class FrameLabels:
    """A field that knows the true classes of one frame, and nothing else: the cheapest there is."""

    def __init__(self, label_set: LabelSet) -> None:
        self.label_set = label_set
        self.holds_scene, self.rays_per_chunk = False, CHUNK
        self.sampling = SamplingConfig()
        self.frame: PosedFrame | None = None

    def encode(self, view: WorkingView) -> NoView:
        """Nothing of the view is kept."""
        return NoView()

    def stack(self, views: Sequence[NoView]) -> NoView:
        """Nothing is kept."""
        return views[0]

    def render(self, rays: Rays, sources: NoView) -> Rendered:
        """The label of the pixel that each ray of ``self.frame`` goes through."""
        assert self.frame is not None and self.frame.label is not None
        k, (h, w) = self.frame.intrinsics, self.frame.label.shape
        x, y, z = (rays.direction.astype(np.float64) @ self.frame.T_world_camera[:3, :3]).T
        u, v = np.rint(k.fx * x / z + k.cx), np.rint(k.fy * y / z + k.cy)
        label = self.frame.label[np.clip(v, 0, h - 1).astype(int), np.clip(u, 0, w - 1).astype(int)]
        channel = self.label_set.to_channels(label)
        known = channel >= 0
        logits = np.zeros((len(label), len(self.label_set)), np.float32)
        logits[known, channel[known]] = 8.0
        depth = rays.prior_depth_m
        return Rendered(logits, depth, (depth > 0).astype(np.float32), np.zeros((len(label), 3), np.float32), known)

    def release(self) -> None:
        """Nothing: it holds nothing."""

    def source_logits(self, sources: NoView) -> None:
        """No opinion."""


class Run:
    """One mapper over one sequence, and how its answers compare with truth.

    Args:
        mode: Of ``MODES``.
        stretch: That it maps.
        weights: File or name of weights of the field; None = true classes.
    """

    def __init__(self, mode: str, stretch: Stretch, weights: Path | None = None) -> None:
        motion, classes = MODES[mode]
        changes = {"moving": {"motion": motion, "classes": classes}}
        self._knows, self._true = mode == "truth", FrameLabels(stretch.labels)
        config = convert_config(changes, MapperConfig, f"benchmark, mode {mode}")
        self._weights = weights
        if weights is None:
            self.pipeline = MappingPipeline(config, self._true, stretch.labels)
        else:
            self.pipeline = Mapper.load(weights, config).pipeline
        self.cpu_s: list[float] = []
        self.hit = self.false = self.missed = self.measured = 0
        self.on_still = 0  # false pixels on what never moves
        self.seen_free = np.zeros(2, int)  # of moving pixels, every third: those seen free before, of these found
        self.found = np.zeros((len(stretch.things) + 1, 2), int)  # of each thing: moving pixels, of these found

    def step(self, seen: Seen, number: int, free_before: Bool) -> None:
        """Map a frame and count; ``free_before`` from ``was_free``."""
        frame = seen.frame
        depth_m = frame.depth_m
        assert depth_m is not None
        if self._knows:
            frame = replace(frame, depth_m=np.where(seen.moving, 0, depth_m).astype(np.float32))
        self._true.frame = frame
        frame = frame if self._weights is None else replace(frame, label=None)
        start = time.process_time()
        update = self.pipeline.step(frame)
        self.cpu_s.append(time.process_time() - start)
        answer = seen.moving if self._knows else getattr(update, "moving", None)
        if number < FIRST:
            return
        measured = depth_m > 0
        answer = (np.zeros_like(measured) if answer is None else answer) & measured
        truth = seen.moving & measured
        self.hit += int((answer & truth).sum())
        self.false += int((answer & ~truth).sum())
        self.missed += int((truth & ~answer).sum())
        self.measured += int(measured.sum())
        self.on_still += int((answer & (seen.thing == 0)).sum())
        free = free_before & truth[::STRIDE, ::STRIDE]
        self.seen_free += (free.sum(), (free & answer[::STRIDE, ::STRIDE]).sum())
        for column, pixels in enumerate((truth, truth & answer)):
            self.found[:, column] += np.bincount(seen.thing[pixels], minlength=len(self.found))

    def xyz(self) -> Float64:
        """(N, 3) surface points of the map."""
        return self.pipeline.voxel_map.points().xyz.astype(np.float64)


def cloud(seen: Seen) -> Float64:
    """(h, w, 3) points in the world of every third pixel, by exact depth."""
    k, depth = seen.frame.intrinsics, seen.depth_m[::STRIDE, ::STRIDE]
    h, w = depth.shape
    coarse = CameraIntrinsics(k.fx / STRIDE, k.fy / STRIDE, k.cx / STRIDE, k.cy / STRIDE, w, h)
    return transform(seen.frame.T_world_camera, unproject(depth, coarse).reshape(-1, 3)).reshape(h, w, 3)


def was_free(seen: Seen, before: Sequence[Seen]) -> Bool:
    """(h, w), of every third pixel, whether it moves now and a frame before looked through where it is.

    Depth alone tells no more than these from what stands.
    """
    free = seen.moving[::STRIDE, ::STRIDE] & False
    now = np.nonzero(seen.moving[::STRIDE, ::STRIDE])
    xyz = cloud(seen)[now]
    for other in before:
        free[now] |= sees_through(replace(other.frame, depth_m=other.depth_m), xyz)
    return free


class Surface:
    """Points of a surface, one a cell."""

    def __init__(self) -> None:
        self._cells: dict[int, Float64] = {}

    def add(self, seen: Seen, pixels: Bool) -> None:
        """The pixels (H, W) of a frame."""
        xyz = cloud(seen)[(pixels & (seen.depth_m > LEAST_DEPTH_M))[::STRIDE, ::STRIDE]]
        cells = np.rint(xyz / CELL_M).astype(np.int64) + (1 << 20)
        keys = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
        self._cells.update(zip(keys.tolist(), xyz, strict=True))

    def distance(self, xyz: Float64) -> Float64:
        """(N,) of points (N, 3), inf where there is no surface."""
        if not self._cells or not len(xyz):
            return np.full(len(xyz), np.inf)
        return KDTree(np.array(list(self._cells.values()))).query(xyz)[0]


def map_stretch(stretch: Stretch, modes: Sequence[str], weights: Path | None = None) -> dict[str, dict[str, Any]]:
    """Figures by mode."""
    runs, bare = ({mode: Run(mode, stretch, weights) for mode in modes} for _ in range(2))
    things, static = [Surface() for _ in stretch.things], Surface()
    before: deque[Seen] = deque(maxlen=BEFORE // EVERY)
    for number, (seen, still) in enumerate(zip(stretch.moving, stretch.still, strict=True)):
        free = was_free(seen, before)
        if number % EVERY == 0:
            before.append(seen)
        for mode in modes if number % 2 else reversed(modes):
            runs[mode].step(seen, number, free)
            bare[mode].step(still, number, free & False)
        static.add(still, still.depth_m > 0)
        for index, surface in enumerate(things):
            surface.add(seen, seen.thing == index + 1)
            if stretch.stays[index, number]:
                static.add(seen, seen.thing == index + 1)
    kept = bare["off"].xyz()
    off_s = float(np.sum(runs["off"].cpu_s[FIRST:]))
    figures: dict[str, dict[str, Any]] = {}
    for mode, run in runs.items():
        xyz = run.xyz()
        away = static.distance(xyz) > APART_M
        ghosts = dict.fromkeys(stretch.things, 0)
        for name, surface in zip(stretch.things, things, strict=True):
            ghosts[name] += int((away & (surface.distance(xyz) < NEAR_M)).sum())
        reach = run.pipeline.config.voxel_map.voxel_size_m
        alone = bare[mode]
        found = {name: [0, 0] for name in stretch.things}
        for name, counts in zip(stretch.things, run.found[1:], strict=True):
            found[name] = [a + int(b) for a, b in zip(found[name], counts, strict=True)]
        figures[mode] = {
            "hit": run.hit, "false": run.false, "missed": run.missed, "false_on_what_never_moves": run.on_still,
            "seen_free": int(run.seen_free[0]), "seen_free_found": int(run.seen_free[1]),
            "measured": run.measured, "found": found, "ghosts": ghosts, "points": len(xyz),
            "still_room_false": alone.hit + alone.false, "still_room_measured": alone.measured,
            "still_room_points": len(kept), "still_room_lost": _lost(kept, alone.xyz(), reach),
            "lost_beside_things": _lost(kept, xyz, 2 * reach),
            "cpu_ms": 1e3 * float(np.mean(run.cpu_s[FIRST:])), "cpu_ratio": float(np.sum(run.cpu_s[FIRST:])) / off_s,
        }  # fmt: skip
    return figures


def _lost(kept: Float64, xyz: Float64, reach: float) -> int:
    return int((KDTree(xyz).query(kept, distance_upper_bound=reach)[0] > reach).sum())


def total(stretches: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """Figures of all stretches together, by mode."""
    result: dict[str, dict[str, Any]] = {}
    for mode in stretches[0]:
        rows = [figures[mode] for figures in stretches]
        n = {key: sum(row[key] for row in rows) for key in rows[0] if isinstance(rows[0][key], int)}
        names = sorted({name for row in rows for name in row["found"]})
        found = {name: np.sum([row["found"].get(name, [0, 0]) for row in rows], axis=0) for name in names}
        result[mode] = {
            "iou": n["hit"] / max(n["hit"] + n["false"] + n["missed"], 1),
            "precision": n["hit"] / max(n["hit"] + n["false"], 1),
            "recall": {name: float(got / there) if there else None for name, (there, got) in found.items()},
            "recall_of_seen_free": n["seen_free_found"] / max(n["seen_free"], 1),
            "seen_free_fraction": n["seen_free"] * STRIDE**2 / max(n["hit"] + n["missed"], 1),
            "moving_fraction": (n["hit"] + n["missed"]) / max(n["measured"], 1),
            "false_on_what_never_moves": n["false_on_what_never_moves"] / max(n["measured"], 1),
            "false_in_still_room": n["still_room_false"] / max(n["still_room_measured"], 1),
            "ghosts": {name: sum(row["ghosts"].get(name, 0) for row in rows) for name in names},
            "points": n["points"],
            "lost_in_still_room": n["still_room_lost"] / max(n["still_room_points"], 1),
            "lost_beside_things": n["lost_beside_things"] / max(n["still_room_points"], 1),
            "cpu_ms": float(np.mean([row["cpu_ms"] for row in rows])),
            "cpu_ratio": [round(row["cpu_ratio"], 3) for row in rows],
        }
    return result


def room_stretch(seed: int, count: int, camera: CameraIntrinsics, people: int, *, exact: bool) -> Stretch:
    """A generated room."""
    noise = None if exact else NoiseConfig()
    room = make_moving_room(seed, count, people=people, room=ROOM, path=PATH)
    poses = [thing.T_world_rest for thing in room.things]
    stays = [
        (T[-1] == T).all((1, 2)) & t.there & t.there[-1] & (t.name != PERSON)
        for t, T in zip(room.things, poses, strict=True)
    ]

    def moving() -> Iterator[Seen]:
        for view in moving_views(room, camera, noise=noise):
            yield Seen(view.view.frame, view.view.rendered.exact_depth_m, view.thing, view.moving)

    def still() -> Iterator[Seen]:
        for view in room_views(seed, count, camera, room=ROOM, path=PATH, noise=noise):
            none = np.zeros(view.rendered.label.shape, np.uint8)
            yield Seen(view.frame, view.rendered.exact_depth_m, none, none > 0)

    names = [thing.name for thing in room.things]
    label = f"room {seed} ({room.scene.template})"
    return Stretch(label, room.scene.label_set, names, np.array(stays), moving(), still())


def with_wrong_poses(stretch: Stretch, sigma_cm: float, sigma_deg: float, *, slow: bool) -> Stretch:
    """The same with errors of the poses, standard deviation an axis; ``slow``: a drift that changes within two seconds.

    Points are placed by these poses, too: only what is said of pixels holds then.
    """

    def wrong(frames: Iterator[Seen]) -> Iterator[Seen]:
        noise = np.random.default_rng(0).normal(size=(MOST_FRAMES, 6))
        if slow:
            noise = gaussian_filter1d(noise, SLOW_FRAMES, axis=0)
            noise /= noise.std(axis=0)
        for seen, error in zip(frames, noise, strict=False):
            T = seen.frame.T_world_camera.copy()
            T[:3, 3] += sigma_cm / 100 * error[:3]
            T[:3, :3] = T[:3, :3] @ Rotation.from_euler("xyz", sigma_deg * error[3:], degrees=True).as_matrix()
            yield seen._replace(frame=replace(seen.frame, T_world_camera=T))

    return stretch._replace(moving=wrong(stretch.moving), still=wrong(stretch.still))


def log_stretch(path: Path, start: int, count: int) -> Stretch:
    """A recording, and a cylinder that walks through it to and fro."""
    with open_log(path) as log:
        frames = list(log)[start : start + count]
        own = log.info.label_set
    assert own is not None, "the log has no labels"
    labels = own if PERSON in own.names else own.with_names((PERSON,))
    up = camera_up(np.stack([f.T_world_camera for f in frames]))
    places = [place_thing(frame, up, (0.2, 0.2, 0.85), is_round=True) for frame in frames[::10]]
    person = min(places, key=lambda place: abs(_hidden(frames, place) - HIDDEN))

    def moving() -> Iterator[Seen]:
        for frame in frames:
            there = with_thing(frame, _walked(person, frame.stamp_ns), labels.id_of(PERSON))
            assert there.depth_m is not None
            hides = there.depth_m != frame.depth_m
            yield Seen(there, there.depth_m, hides.astype(np.uint8), hides)

    def still() -> Iterator[Seen]:
        for frame in frames:
            assert frame.depth_m is not None
            none = np.zeros(frame.depth_m.shape, np.uint8)
            yield Seen(frame, frame.depth_m, none, none > 0)

    stays = np.zeros((1, len(frames)), bool)
    return Stretch(f"{path.stem} from {start}", labels, [PERSON], stays, moving(), still())


def _walked(person: Thing, stamp_ns: int, reach_m: float = 1.5) -> Thing:
    """Where a thing is that walks at 1 m/s along its own x axis, ``reach_m`` to either side."""
    along = abs((stamp_ns / 1e9) % (4 * reach_m) - 2 * reach_m) - reach_m
    T = person.T_thing_world.copy()
    T[0, 3] -= along
    return person._replace(T_thing_world=T)


def _hidden(frames: Sequence[PosedFrame], person: Thing) -> float:
    """Fraction of the pictures that a walking thing hides."""
    some = frames[::10]
    there = [with_thing(frame, _walked(person, frame.stamp_ns), 0) for frame in some]
    return float(np.mean([a.depth_m != b.depth_m for a, b in zip(there, some, strict=True)]))


def main() -> None:
    """Print the figures of each room or stretch of a log, and of all together, as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", help="`rooms`, or a log with labels")
    parser.add_argument("--rooms", type=int, default=5, help="test rooms")
    parser.add_argument("--frames", type=int, default=150, help="of each room; of each of two stretches of a log")
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--width", type=int, default=640, help="of the pictures of rooms")
    parser.add_argument("--exact", action="store_true", help="rooms without noise and holes in depth")
    parser.add_argument("--modes", nargs="+", choices=tuple(MODES), default=["off", "motion", "truth"])
    parser.add_argument("--weights", type=Path, help="S-Ray with these weights tells the classes")
    parser.add_argument("--pose-noise", nargs=2, type=float, metavar=("CM", "DEG"), help="of each frame by itself")
    parser.add_argument("--slow", action="store_true", help="pose noise that drifts")
    given = parser.parse_args()
    if "off" not in given.modes:
        parser.error("--modes: all others are compared with off")
    if given.what == "rooms":
        scale = given.width / 640
        camera = CameraIntrinsics(
            525 * scale, 525 * scale, 320 * scale - 0.5, 240 * scale - 0.5, given.width, round(480 * scale)
        )
        stretches = (
            room_stretch(seed, given.frames, camera, given.people, exact=given.exact)
            for seed in TEST_SEEDS[: given.rooms]
        )
    else:
        stretches = (log_stretch(Path(given.what), start, given.frames) for start in (0, given.frames))
    result: list[dict[str, dict[str, Any]]] = []
    for stretch in stretches:
        if given.pose_noise:
            stretch = with_wrong_poses(stretch, *given.pose_noise, slow=given.slow)
        result.append(map_stretch(stretch, given.modes, given.weights))
        print(stretch.name, json.dumps(total(result[-1:])), flush=True)
    print(json.dumps(total(result), indent=1))


if __name__ == "__main__":
    main()
