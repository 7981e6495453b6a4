"""What was moved, came, and has gone between two visits to generated homes, against the truth.

    python -m research.experiments.days --split test
    python -m research.experiments.days --split test --own    # labels of S-Ray instead of the true ones
    python -m research.experiments.days --split test --goes-on  # one map of both visits instead of two maps

Homes of ``scenes.days``. Poses of the second visit are off by 2 cm and 0.5 degrees in each room. A change counts where
it could be seen: the thing in ``LEAST_FRAMES`` frames of ``LEAST_PIXELS`` or more, and through its place in as many of
the other visit. What is reported at a place of one that does not count is left out. Right is a report of the same kind
with its places at the true ones.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from research.experiments.put_things import map_frame, sees_through
from research.scenes.config import NoiseConfig
from research.scenes.days import DayChange, make_home, next_day, pose_errors, visit
from research.scenes.sequence import RoomView
from research.suites.config import camera_of_width
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.geometry import unproject
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.localization.places import DESCRIPTOR_BYTES, Place
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import InstanceTracker, OrientedBox
from semantic_mapper.queries.objects import ObjectChange, ObjectMemory, changes_of
from semantic_mapper.queries.revisit import Looks, MapVisit
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import PosedFrame

SPLITS = {"tune": range(60_000, 60_006), "test": range(80_000, 80_020)}
FRAMES = 160  # of a visit to a room
WIDTH, OWN_WIDTH = 160, 320  # of images
LEAST_FRAMES, LEAST_PIXELS = 3, 50  # of 160 x 120
UP = np.array((0.0, 0.0, 1.0))
KINDS = ("moved", "new", "gone")
VISIT_NS = 86_400_000_000_000
FRAME_NS = 66_666_667
PROBES = 60  # points in a thing's box


class Truth(NamedTuple):
    """A true change and whether it counts."""

    kind: str
    before: list[list[float]] | None
    after: list[list[float]] | None
    label: int
    counts: bool


class _Seen:
    """Counts in how many frames each change is seen, and seen through, on both days."""

    def __init__(self, changes: Sequence[DayChange]) -> None:
        rng = np.random.default_rng(0)
        self.boxes = [(c.before, c.after) for c in changes]
        self.labels = [c.label for c in changes]
        self.probes = [
            tuple(None if b is None else b[0] + rng.uniform(0.1, 0.9, (PROBES, 3)) * (b[1] - b[0]) for b in pair)
            for pair in self.boxes
        ]
        self.there, self.through = np.zeros((2, len(changes), 2), np.int64)  # (change, place: before or after)

    def look(self, view: RoomView, day: int) -> None:
        """Count a frame of day 0 or 1."""
        frame = replace(view.frame, T_world_camera=view.T_world_camera, depth_m=view.rendered.exact_depth_m)
        k, depth = frame.intrinsics, frame.depth_m
        assert depth is not None
        xyz = unproject(depth, k).reshape(-1, 3) @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
        label = view.rendered.label.ravel()
        for n, pair in enumerate(self.boxes):
            for place, box in enumerate(pair):
                if box is None or np.linalg.norm(box.mean(axis=0) - frame.T_world_camera[:3, 3]) > 6:
                    continue
                if place == day:
                    inside = ((xyz > box[0] - 0.01) & (xyz < box[1] + 0.01)).all(axis=1) & (label == self.labels[n])
                    self.there[n, place] += inside.sum() >= LEAST_PIXELS
                else:
                    probes = self.probes[n][place]
                    assert probes is not None
                    self.through[n, place] += sees_through(frame, probes).mean() > 0.4

    def truths(self, changes: Sequence[DayChange]) -> list[Truth]:
        """The changes, and whether each counts."""
        there, through = self.there >= LEAST_FRAMES, self.through >= LEAST_FRAMES
        found: list[Truth] = []
        for n, change in enumerate(changes):
            left, came = (there[n, day] and through[n, day] for day in (0, 1))
            counts = {"gone": left, "new": came, "moved": left and came}.get(change.kind, there[n].all())
            was, now = (None if b is None else b.tolist() for b in (change.before, change.after))
            found.append(Truth(change.kind, was, now, change.label, bool(counts)))
        return found


class Labelled:
    """A map of true labels, with views as a mapper keeps them."""

    def __init__(self, voxel_map: VoxelMap | None, label_set: LabelSet = ROOMS) -> None:
        self.voxel_map = VoxelMap(VoxelMapConfig(), label_set) if voxel_map is None else voxel_map

    def add(self, frame: PosedFrame) -> None:
        """Fuse a frame."""
        map_frame(self.voxel_map, frame)
        if self.voxel_map.places.wants(frame.T_world_camera):
            assert frame.depth_m is not None
            points = unproject(frame.depth_m, frame.intrinsics)[4::10, 4::10].reshape(-1, 3)
            points = points[points[:, 2] > 0].astype(np.float32)
            none = np.zeros((len(points), DESCRIPTOR_BYTES), np.uint8)
            self.voxel_map.places.add(Place("rooms", frame.stamp_ns, frame.T_world_camera, points, none))


class _Own:
    """A map of S-Ray's labels."""

    def __init__(self, voxel_map: VoxelMap | None) -> None:
        self.pipeline = Mapper.load(default_checkpoint_path()).pipeline
        self.voxel_map = self.pipeline.voxel_map
        if voxel_map is not None:
            self.voxel_map.take_over(voxel_map)

    def add(self, frame: PosedFrame) -> None:
        self.pipeline.step(replace(frame, label=None))


def map_days(seed: int, *, changes: bool, own: bool, apart: bool) -> tuple[MapVisit, MapVisit, list[Truth]]:
    """Map both visits to a home; the second goes on in the first map, or is ``apart``."""
    home = make_home(seed)
    later, true = next_day(home, seed, changes=changes)
    seen = _Seen(true)
    errors = pose_errors(np.random.default_rng((78, seed)), len(home.rooms))
    camera = camera_of_width(OWN_WIDTH if own else WIDTH)
    visits, voxel_map = list[MapVisit](), None
    for day, rooms in enumerate((home, later)):
        mapper = (_Own if own else Labelled)(None if apart else voxel_map)
        views = visit(rooms, seed + 31 * day, FRAMES, camera, NoiseConfig(), errors if day else ())
        for number, (_, view) in enumerate(views):
            seen.look(view, day)
            stamp_ns = day * VISIT_NS + (number + 1) * FRAME_NS
            mapper.add(replace(view.frame, stamp_ns=stamp_ns, seq=number))
        voxel_map = mapper.voxel_map
        visits.append(visit_of(voxel_map, day * VISIT_NS))
    return visits[0], visits[1], seen.truths(true)


def visit_of(voxel_map: VoxelMap, since_ns: int) -> MapVisit:
    """A map as it is now, its things, and its views after a stamp."""
    snapshot = MapMirror.of(voxel_map).snapshot()
    looks = Looks.of(voxel_map.places.places, since_ns)
    return MapVisit(snapshot, InstanceTracker(up=UP).update(snapshot), looks, voxel_map.last_stamp_ns)


class Report(NamedTuple):
    """A change that was found, and where: boxes before and now."""

    kind: str
    title: str
    before: OrientedBox | None
    after: OrientedBox | None


def reports_of(changes: Sequence[ObjectChange]) -> list[Report]:
    """As places, to be compared with the truth."""
    found: list[Report] = []
    for change in changes:
        before = None if change.before is None else change.before.box
        after = None if change.kind == "gone" else change.object.box
        found.append(Report(change.kind, f"{change.object.class_name} {change.object.id}", before, after))
    return found


def compare(before: MapVisit, after: MapVisit) -> list[Report]:
    """What the product finds."""
    memory = ObjectMemory()
    memory.update(before, UP)
    memory.update(after, UP, before=before)
    return reports_of(changes_of(memory.objects, before.stamp_ns))


class Score(NamedTuple):
    """Of one home, by kind."""

    right: Counter[str]
    reported: Counter[str]
    true: Counter[str]


def near(found: OrientedBox, box: Any) -> bool:
    """Whether a box that was found lies at a true one."""
    low, high = np.array(box)
    limit = 0.15 + 0.3 * float(np.linalg.norm(high - low))
    return bool(np.linalg.norm(found.center - (low + high) / 2) < limit)


def judge(reports: Sequence[Report], truth: Sequence[Truth], say: bool) -> Score:
    """Compare reports with the truth."""
    score, left, wrong = Score(Counter(), Counter(), Counter()), list(truth), list[Report]()
    score.true.update(_kind(t) for t in truth if t.counts and t.kind != "swapped")
    for report in reports:
        for t in left:
            same = report.kind == _kind(t) and t.counts
            places = ((report.before, t.before), (report.after, t.after))
            if same and all(found is None or near(found, box) for found, box in places):
                left.remove(t)
                score.right[report.kind] += 1
                score.reported[report.kind] += 1
                break
        else:
            wrong.append(report)
    uncounted = [box for t in truth if not t.counts and t.kind != "swapped" for box in (t.before, t.after) if box]
    for report in wrong:
        places = [box for box in (report.before, report.after) if box is not None]
        if any(near(found, box) for found in places for box in uncounted):
            continue
        score.reported[report.kind] += 1
        if say:
            print("   wrong", report.kind, report.title, *(f"{b.center.round(2)} {b.size.round(2)}" for b in places))
    for t in left:
        if say and t.counts and t.kind != "swapped":
            name = ROOMS.names[ROOMS.ids.index(t.label)]
            print("   missed", t.kind, name, *(np.mean(b, axis=0).round(2) for b in (t.before, t.after) if b))
    return score


def _kind(truth: Truth) -> str:
    return "moved" if truth.kind == "nudged" else truth.kind


def show(scores: Sequence[Score]) -> None:
    """Print F1 by kind."""
    for kind in KINDS:
        right, reported, true = (sum(getattr(s, name)[kind] for s in scores) for name in Score._fields)
        f1 = 2 * right / max(1, reported + true)
        print(f"{kind:6s} {true:4d} true, {reported:4d} reported, {right:4d} right: F1 {f1:.2f}")


def score_home(seed: int, arguments: argparse.Namespace, *, changes: bool) -> Score:
    """Map a home twice and compare."""
    before, after, truth = map_days(seed, changes=changes, own=arguments.own, apart=not arguments.goes_on)
    began = time.perf_counter()
    reports = compare(before, after)
    took = time.perf_counter() - began
    score = judge(reports, truth, arguments.say)
    right, reported, true = (getattr(score, name).total() for name in Score._fields)
    what = f"{right} of {true} found, {reported - right} false" if changes else f"unchanged, {reported} false"
    print(f"home {seed}: {what}, {took:.1f} s", flush=True)
    return score


def main() -> None:
    """Map what is missing, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=tuple(SPLITS), default="tune")
    parser.add_argument("--homes", type=int, default=20)
    parser.add_argument("--own", action="store_true", help="labels of S-Ray")
    parser.add_argument("--goes-on", action="store_true", help="the second visit goes on in the map of the first")
    parser.add_argument("--say", action="store_true", help="name each error")
    arguments = parser.parse_args()
    changed, false = list[Score](), list[int]()
    for seed in SPLITS[arguments.split][: arguments.homes]:
        changed.append(score_home(seed, arguments, changes=True))
        false.append(score_home(seed, arguments, changes=False).reported.total())
    show(changed)
    print(f"unchanged: {sum(n > 0 for n in false)} of {len(false)} homes with a false change, {sum(false)} in all")


if __name__ == "__main__":
    main()
