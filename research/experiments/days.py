"""What was moved, came, and has gone between two visits to generated homes, against the truth.

    python -m research.experiments.days --split test
    python -m research.experiments.days --split test --own    # labels of S-Ray instead of the true ones

Homes of ``scenes.days``, each visited three times: on the second visit only the light has changed. Each visit makes a
map of its own. Poses of the later ones are off by 2 cm and 0.5 degrees in each room. A change counts where it could be
seen: the thing in ``LEAST_FRAMES`` frames of ``LEAST_PIXELS`` or more, and through its place in as many of the other
visit. What is reported at a place of one that does not count is left out. Right is a report of the same kind with its
places at the true ones. Identity: what stood, or was moved, has the id at the end that it had in the first map, after
that was saved and merged with the second, and the third compared with both.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from research.experiments.put_things import map_frame, sees_through
from research.experiments.relocalization import WITHIN_DEG, WITHIN_M, lock
from research.scenes.config import NoiseConfig
from research.scenes.days import SHELL, TEMPLATES, DayChange, Home, make_home, next_day, pose_errors, visit
from research.scenes.materials import Pattern
from research.scenes.sequence import RoomView
from research.suites.config import camera_of_width
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.geometry import unproject
from semantic_mapper.labels import ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.localization.features import find_place_features
from semantic_mapper.localization.places import MAX_FEATURES, make_place, view_distances
from semantic_mapper.localization.relocalizer import Relocalized, Relocalizer, sighting
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.odometry_sessions import HELD
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.fleet.merge import merge_maps
from semantic_mapper.queries.instances import InstanceTracker, OrientedBox
from semantic_mapper.queries.objects import MapObject, ObjectChange, ObjectMemory, changes_of, remember
from semantic_mapper.queries.revisit import Looks, MapVisit
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.types import Float64, PosedFrame

SPLITS = {"tune": range(60_000, 60_006), "test": range(80_000, 80_020)}
FRAMES = 160  # of a visit to a room
WIDTH, OWN_WIDTH = 160, 320  # of images
LEAST_FRAMES, LEAST_PIXELS = 3, 50  # of 160 x 120
UP = np.array((0.0, 0.0, 1.0))
KINDS = ("moved", "new", "gone")
VISIT_NS = 86_400_000_000_000
FRAME_NS = 66_666_667
PROBES = 60  # points in a thing's box
SPREAD, MANY = 0.12, {Pattern.SPINES, Pattern.PRINT, Pattern.PAGE, Pattern.OUTSIDE}  # of one colour; of many


class Truth(NamedTuple):
    """A true change and whether it counts."""

    kind: str
    before: list[list[float]] | None
    after: list[list[float]] | None
    label: int
    counts: bool


class Thing(NamedTuple):
    """A true thing; ``rgb`` is None where it has no one colour."""

    name: str
    room: str
    low: list[float]
    high: list[float]
    rgb: list[float] | None


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

    def __init__(self, label_set: LabelSet) -> None:
        self.voxel_map = VoxelMap(VoxelMapConfig(), label_set)

    def add(self, frame: PosedFrame) -> None:
        """Fuse a frame."""
        map_frame(self.voxel_map, frame)
        if self.voxel_map.places.wants(frame.T_world_camera):
            assert frame.depth_m is not None
            features = find_place_features(frame.rgb, frame.depth_m, MAX_FEATURES)
            T, k = frame.T_world_camera, frame.intrinsics
            self.voxel_map.places.add(make_place(frame.camera_id, frame.stamp_ns, T, features, k))


class OwnLabels:
    """A map of S-Ray's labels."""

    def __init__(self) -> None:
        self.pipeline = Mapper.load(default_checkpoint_path()).pipeline
        self.voxel_map = self.pipeline.voxel_map

    def add(self, frame: PosedFrame) -> None:
        """Fuse a frame."""
        self.pipeline.step(replace(frame, label=None))


def map_days(seed: int, own: bool, path: Path) -> None:
    """Visit a home three times; write the maps, and what is true, last."""
    home, rng = make_home(seed), np.random.default_rng((78, seed))
    same, later, true = next_day(home, seed, changes=False)[0], *next_day(home, seed)
    seen, counts = _Seen(true), np.zeros((2, len(home.rooms), 1 << 16), np.int64)
    camera, starts, finder = camera_of_width(OWN_WIDTH if own else WIDTH), [list[RoomView]() for _ in home.rooms], None
    for day, rooms in enumerate((home, same, later)):
        mapper, errors = OwnLabels() if own else Labelled(ROOMS), pose_errors(rng, len(home.rooms)) if day else ()
        for number, (room, view) in enumerate(visit(rooms, seed + 31 * day, FRAMES, camera, NoiseConfig(), errors)):
            if day != 1:
                seen.look(view, day // 2)
                shown = np.bincount(view.rendered.instance.ravel(), minlength=1 << 16)
                counts[day // 2, room] += shown >= LEAST_PIXELS
            starts[room] += [view] * (day == 2)
            mapper.add(replace(view.frame, stamp_ns=day * VISIT_NS + (number + 1) * FRAME_NS, seq=number))
        mapper.voxel_map.save(path.with_suffix(f".{day}.npz"))
        finder = finder or Relocalizer(mapper.voxel_map.places.places, mapper.voxel_map, ROOMS.ignore_id)
    assert finder is not None
    found = [find_start(finder, views) for views in starts]
    was, now = (list(things_of(*pair)) for pair in zip((home, later), counts, strict=True))
    stood = [(ROOMS.id_of(t.name), t.low, t.high) for t in was if t in now]
    path.write_text(json.dumps({"truth": seen.truths(true), "stood": stood, "starts": found}))


def find_start(finder: Relocalizer, views: Sequence[RoomView]) -> int:
    """By how many of these views a robot that starts with them has found itself in a map; less than 0 where it has
    done so wrongly, and 0 where it has not."""
    looks = (finder.find(v.frame.rgb, v.frame.depth_m, v.frame.intrinsics) for v in views)
    found = lock(
        sighting(look.T_map_camera, view.frame.T_world_camera) if isinstance(look, Relocalized) else None
        for view, look in zip(views, looks, strict=True)
    )
    if found is None:
        return 0
    number, T_map_world = found
    frame, T = views[number - 1].frame, views[number - 1].T_world_camera
    off_m, off_rad = view_distances(T_map_world @ frame.T_world_camera, T)
    return number if off_m <= WITHIN_M and off_rad <= np.radians(WITHIN_DEG) else -number


def things_of(home: Home, counts: np.ndarray) -> Iterator[Thing]:
    """The countable things that enough frames saw, by how many saw each (rooms, instances)."""
    for room, (scene, offset) in enumerate(zip(home.rooms, home.offsets, strict=True)):
        p, m = scene.primitives, scene.materials
        low, high = p.bounds()
        for number in np.unique(p.instance[p.group >= SHELL]).tolist():
            own = p.instance == number
            label = int(p.label[own][0])
            name = ROOMS.names[ROOMS.ids.index(label)] if label in ROOMS.ids else "floor"
            if name in STUFF_NAMES or counts[room, number] < LEAST_FRAMES:
                continue
            rows, area = p.material[own], np.repeat(p.half[own].prod(axis=1) ** (2 / 3), 2)
            colors: Float64 = np.stack((m.color_a[rows], m.color_b[rows]), axis=1).reshape(-1, 3) ** (1 / 2.2)
            mean = area @ colors / area.sum()
            spread = np.sqrt(area @ ((colors - mean) ** 2).sum(axis=1) / area.sum())
            one = spread < SPREAD and not m.emission[rows].any() and not MANY & set(m.pattern[rows].tolist())
            box = (low[own].min(axis=0) + offset).tolist(), (high[own].max(axis=0) + offset).tolist()
            yield Thing(name, TEMPLATES[room], *box, mean.tolist() if one else None)


def visit_of(voxel_map: VoxelMap) -> MapVisit:
    """A map, its things, and its views."""
    snapshot, looks = MapMirror.of(voxel_map).snapshot(), Looks.of(voxel_map.places.places)
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


def judge(reports: Sequence[Report], truth: Sequence[Truth], say: bool) -> tuple[Score, list[Truth]]:
    """Compare reports with the truth; and what of it is not found."""
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
    return score, left


def is_hidden(change: Truth, *visits: MapVisit) -> bool:
    """Whether at least one of both visits saw less than half of a thing's outside."""
    for visit_, box in zip(visits, (change.before, change.after), strict=True):
        there = [t.seen for t in visit_.things if box and t.class_id == change.label and near(t.box, box)]
        if box and max(there, default=0) < 0.5:
            return True
    return False


def _kind(truth: Truth) -> str:
    return "moved" if truth.kind == "nudged" else truth.kind


def show(scores: Sequence[Score]) -> None:
    """Print F1 by kind."""
    for kind in KINDS:
        right, reported, true = (sum(getattr(s, name)[kind] for s in scores) for name in Score._fields)
        f1 = 2 * right / max(1, reported + true)
        print(f"{kind:6s} {true:4d} true, {reported:4d} reported, {right:4d} right: F1 {f1:.2f}")


def kept(files: Sequence[Path], things: Sequence[Any], truth: Sequence[Truth], folder: Path) -> Counter[str]:
    """Of what was found in the first map, by what became of it: how many, and how many have their id at the end."""
    first, last, one = VoxelMap.load(files[0]), VoxelMap.load(files[2]), folder / "one.npz"
    remember(first)
    first.save(one)
    sources = {"first": str(one), "second": str(files[1])}
    merge_maps(sources, dict.fromkeys(sources, np.eye(4))).merged.save(one)  # both know where they are
    before = VoxelMap.load(one)
    last.objects, last.objects_version = before.objects, 0
    remember(last, visit_of(before))
    was, now = (ObjectMemory.from_bytes(m.objects).there for m in (first, last))
    rows = [("stood", label, (low, high), (low, high)) for label, low, high in things]
    rows += [("moved", t.label, t.before, t.after) for t in truth if t.counts and _kind(t) == "moved"]
    counts = Counter[str]()
    for kind, *places in ((kind, _at(was, label, a), _at(now, label, b)) for kind, label, a, b in rows):
        before, after = places
        counts[kind] += before is not None
        counts[f"{kind} with id"] += before is not None and after is not None and before.id == after.id
    return counts


def _at(objects: Sequence[MapObject], label: int, box: Any) -> MapObject | None:
    """The object of a class that is nearest to the middle of a true box, and at it."""
    there = [o for o in objects if o.class_id == label and near(o.box, box)]
    return min(there, key=lambda o: float(np.linalg.norm(o.box.center - np.mean(box, axis=0))), default=None)


def main() -> None:
    """Map what is missing, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=tuple(SPLITS), default="tune")
    parser.add_argument("--homes", type=int, default=20)
    parser.add_argument("--own", action="store_true", help="labels of S-Ray")
    parser.add_argument("--out", type=Path, default=Path("runs/days"), help="maps; made where they are missing")
    parser.add_argument("--say", action="store_true", help="name each error")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    changed, false, starts, ids, hard = list[Score](), list[int](), list[int](), Counter[str](), Counter[str]()
    for seed in SPLITS[arguments.split][: arguments.homes]:
        path = arguments.out / f"{seed}{'-own' if arguments.own else ''}.json"
        if not path.exists():
            map_days(seed, arguments.own, path)
        rows = json.loads(path.read_text())
        truth, files = [Truth(*row) for row in rows["truth"]], [path.with_suffix(f".{day}.npz") for day in range(3)]
        first, same, later = (visit_of(VoxelMap.load(file)) for file in files)
        reports = compare(first, later)
        score, missed = judge(reports, truth, arguments.say)
        changed.append(score)
        false.append(judge(compare(first, same), [], arguments.say)[0].reported.total())
        for t in truth:
            if t.kind == "swapped":
                hard["swapped"] += 1
                hard["swapped found"] += any(r.after is not None and near(r.after, t.after) for r in reports)
            for name in ("half hidden",) * is_hidden(t, first, later) + ("moved 10 cm",) * (t.kind == "nudged"):
                hard[name] += t.counts and t.kind != "swapped"
                hard[f"{name} found"] += t.counts and t not in missed
        starts += rows["starts"]
        ids += kept(files, rows["stood"], truth, arguments.out)
        right, reported, true = (getattr(changed[-1], name).total() for name in Score._fields)
        print(f"home {seed}: {right} of {true} found, {reported - right} false; unchanged: {false[-1]}", flush=True)
    show(changed)
    print(*(f"{n}: {hard[f'{n} found']} of {hard[n]}" for n in ("half hidden", "moved 10 cm", "swapped")), sep="; ")
    print(f"unchanged: {sum(n > 0 for n in false)} of {len(false)} homes with a false change, {sum(false)} in all")
    right, soon = (sum(0 < n <= most for n in starts) for most in (FRAMES, HELD))
    print(
        f"relocalised: {right} of {len(starts)} starts, {soon} within {HELD} frames, {sum(n < 0 for n in starts)} wrong"
    )
    print(*(f"id kept: {ids[f'{kind} with id']} of {ids[kind]} that {kind}" for kind in ("stood", "moved")), sep="\n")


if __name__ == "__main__":
    main()
