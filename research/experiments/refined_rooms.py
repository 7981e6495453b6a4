"""Maps of rooms before and after ``refine``, without the query views of ``suite rooms --map --refine``.

Maps are kept, so that other weights are scored in a fraction of the time. A run that ended early goes on where it was.

Example: python -m research.experiments.refined_rooms --split val --refine nesf-rooms
Example: python -m research.experiments.refined_rooms --split test --refine nesf-rooms --rendered 4
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from research.evaluation.bootstrap import paired_bootstrap
from research.evaluation.instances import InstanceMatch, InstanceMatches, average_precision
from research.evaluation.points import nearest_points
from research.evaluation.room_map import NEAR_M, UP, compare_instances, in_rooms, kept_room
from research.suites.config import SuiteConfig, settings_digest, suite_seeds
from research.suites.records import CalibrationRecord, InstanceRecord, Rows
from research.suites.scoring import as_calibration, as_rows, from_rows
from semantic_mapper.config import Config
from semantic_mapper.evaluation.metrics import ConfusionMatrix, calibration_error, confusion_of
from semantic_mapper.fields.nesf import NesfWeights, load_nesf, smoothed_votes
from semantic_mapper.fields.weights import find_checkpoint
from semantic_mapper.labels import ROOMS
from semantic_mapper.mapping.refine import refine
from semantic_mapper.mapping.voxel_map import VoxelMap

RESAMPLES = 100  # of instances


class Scored(Config, frozen=True):
    """A room's map, made in one way."""

    settings: str
    room: int
    points: Rows
    surface: Rows
    calibration: CalibrationRecord
    instances: InstanceRecord


class KeptRoom:
    """The map of a room, from the folder if it is there; what depends on its geometry alone is computed once."""

    def __init__(self, seed: int, suite: SuiteConfig, rendered: int, folder: Path) -> None:
        self.seed = seed
        self._map_file, self._surface = kept_room(seed, suite, folder, rendered)
        self._xyz = VoxelMap.load(self._map_file).points().xyz
        self._truth_of = nearest_points(self._xyz, self._surface.xyz, max_distance_m=NEAR_M)
        self._point_of = nearest_points(self._surface.xyz, self._xyz, max_distance_m=NEAR_M)

    def score(self, settings: str, network: NesfWeights | None) -> Scored:
        """Of the map refined by a network; None = as it is."""
        voxel_map, surface = VoxelMap.load(self._map_file), self._surface
        if network is not None:
            refine(voxel_map, network, up=UP, by_name=True)  # ROOMS has people, the default weights have not
        points = voxel_map.points()
        assert (points.xyz == self._xyz).all(), "refining leaves geometry as it is"
        label = in_rooms(points.label, voxel_map.label_set)
        unknown = np.uint8(ROOMS.ignore_id)
        truth = np.append(surface.label, unknown)[self._truth_of]
        answered = (truth != unknown) & (label != unknown)
        return Scored(
            settings=settings,
            room=self.seed,
            points=as_rows(confusion_of(truth, label, ROOMS, "map")),
            surface=as_rows(confusion_of(surface.label, np.append(label, unknown)[self._point_of], ROOMS, "map")),
            calibration=as_calibration(points.confidence[answered], label[answered] == truth[answered]),
            instances=compare_instances(voxel_map, surface),
        )


def show(name: str, scored: Sequence[Scored], plain: Sequence[Scored]) -> None:
    """Print the figures of one way to make maps, and its differences to the maps as they are."""
    found = [_total([getattr(s, where) for s in scored]).metrics().miou or 0.0 for where in ("points", "surface")]
    calibration = [
        np.sum([getattr(s.calibration, key) for s in scored], axis=0) for key in CalibrationRecord.__struct_fields__
    ]
    ece = calibration_error(*calibration)
    ap = average_precision([_matches(s) for s in scored], ROOMS)
    print(
        f"{name}, {len(scored)} rooms: mIoU of points {100 * found[0]:.1f}, true surface {100 * found[1]:.1f}, ECE "
        f"{100 * (ece or 0):.1f}, instances AP50 {100 * (ap.ap or 0):.1f}, found {100 * (ap.recall or 0):.1f}, right "
        f"{100 * (ap.precision or 0):.1f} of {ap.truth}"
    )
    print("  AP50: " + ", ".join(f"{key} {100 * value:.0f}" for key, value in ap.per_class.items()))
    if scored is plain or len(scored) < 2:
        return
    for where in ("points", "surface"):
        a, b = ([from_rows(getattr(s, where)) for s in side] for side in (scored, plain))
        change = paired_bootstrap(a, b)
        print(f"  {where}: {_points(change.observed)}, 95 % interval {_points(change.low)} to {_points(change.high)}")
    changes = sorted((_miou(a) - _miou(b), a.room) for a, b in zip(scored, plain, strict=True))
    worse = sum(change < 0 for change, _ in changes)
    print(f"  {worse} of {len(changes)} rooms worse, the worst, {changes[0][1]}, by {_points(changes[0][0])}")
    low, high = _interval(scored, plain)
    print(f"  AP50: 95 % interval of the difference {_points(low)} to {_points(high)}")


def _interval(scored: Sequence[Scored], plain: Sequence[Scored]) -> tuple[float, float]:
    """Of the difference in AP50, by a paired bootstrap over rooms."""
    rng = np.random.default_rng(0)
    ours, theirs = ([_matches(s) for s in side] for side in (scored, plain))
    drawn = [rng.integers(len(ours), size=len(ours)) for _ in range(RESAMPLES)]
    a, b = (
        np.array([average_precision([side[n] for n in rows], ROOMS).ap or 0.0 for rows in drawn])
        for side in (ours, theirs)
    )
    low, high = np.percentile(a - b, (2.5, 97.5))
    return float(low), float(high)


def _matches(scored: Scored) -> InstanceMatches:
    return InstanceMatches(tuple(InstanceMatch(*found) for found in scored.instances.found), scored.instances.truth)


def _total(rows: Sequence[Rows]) -> ConfusionMatrix:
    return sum((from_rows(r) for r in rows), ConfusionMatrix(ROOMS))


def _miou(scored: Scored) -> float:
    return from_rows(scored.points).metrics().miou or 0.0


def _points(fraction: float) -> str:
    return f"{100 * fraction:+.1f}"


def main() -> None:
    """Map, refine and score what is missing; print what there is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("val", "test"), default="val")
    parser.add_argument("--rooms", type=int, default=0, help="the first so many; 0 = all")
    parser.add_argument("--refine", type=Path, help="weights from `train --kind nesf`; none = smoothed votes only")
    parser.add_argument("--rendered", type=int, default=1, help="every so many-th frame is rendered")
    parser.add_argument("--folder", type=Path, default=Path("runs/refined-rooms"))
    arguments = parser.parse_args()
    suite = SuiteConfig(split=arguments.split, rooms=arguments.rooms)
    plain = f"{settings_digest(suite, 'map')}-{arguments.rendered}"
    networks = {"as mapped": (plain, None), "smoothed": (f"{plain}-smoothed", smoothed_votes(ROOMS))}
    if arguments.refine:
        network = load_nesf(find_checkpoint(arguments.refine))
        networks["refined"] = (f"{plain}-{network.digest[:16]}", network)
    folder = arguments.folder / f"{arguments.split}-{arguments.rendered}"
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "scored.jsonl"
    lines = file.read_bytes().splitlines() if file.is_file() else []
    known = {(s.settings, s.room): s for s in (msgspec.json.decode(line, type=Scored) for line in lines)}
    for seed in suite_seeds(suite):
        missing = [way for way in networks.values() if (way[0], seed) not in known]
        room = KeptRoom(seed, suite, arguments.rendered, folder) if missing else None
        for settings, network in missing:
            assert room is not None
            known[settings, seed] = scored = room.score(settings, network)
            with file.open("ab") as out:
                out.write(msgspec.json.encode(scored) + b"\n")
            print(f"room {seed}: {_points(_miou(scored))}", flush=True)
    rows = {name: [known[way[0], seed] for seed in suite_seeds(suite)] for name, way in networks.items()}
    for name, scored in rows.items():
        show(name, scored, rows["as mapped"])
    if "refined" in rows:
        a, b = ([from_rows(s.points) for s in rows[name]] for name in ("refined", "smoothed"))
        change = paired_bootstrap(a, b)
        print(
            f"refined over smoothed, points: {_points(change.observed)}, 95 % interval {_points(change.low)} to "
            f"{_points(change.high)}"
        )


if __name__ == "__main__":
    main()
