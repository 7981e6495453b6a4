"""The suite STREETS: arms label every image of a drive from boxes and noisy predicted labels, and are scored on some.

An arm is a function ``arm(config, seed) -> scores`` of one street; most make a function ``answer(frame) -> Answer`` and
hand it to ``score_street``. Records are kept by street, and ``CLAIMS`` are judged by them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Annotated, Any, Literal, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from research.evaluation.points import nearest_points
from research.scenes.sequence import RoomView
from research.scenes.streets.boxes import THINGS, StreetBox, street_boxes
from research.scenes.streets.layout import IGNORED
from research.scenes.streets.pseudo import pseudo_labels
from research.scenes.streets.views import (
    MAX_RANGE_M,
    PAIRS,
    cached_street,
    scanned_pixels,
    street_camera,
    street_pairs,
)
from research.scenes.suite import STREETS_SUITE
from research.suites.claims import Claim, Counts, CountTable, Measure, Unit, miou_measure
from research.suites.records import SceneRecord
from research.suites.scene_runs import ViewScores, counts_of, run_missing
from research.suites.store import RecordStore
from research.train.label_transfer import Transferred, box_crf, nearest_labels
from semantic_mapper.config import AtLeastOne, Config, Fraction, NotNegative, Positive, to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticImage
from semantic_mapper.fields.scene.boxes import PrimitiveSet
from semantic_mapper.fields.scene.primitives import Primitive, ShapeName
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.types import Float32, Float64, PosedFrame, UInt8

RECORD_VERSION = 1  # raised by a change of what a record means: older ones are made again
LABELS, PANOPTIC, AGREEMENT, DEPTH = "labels", "panoptic", "agreement", "depth"  # what is scored
SAME_POINT_M, MOST_APART = 0.1, 10  # of scanned points that two frames share; frames between them
TENFOLD = 10_000  # sums of fractions are kept as integers of this

_LABEL_SET = STREETS_SUITE.label_set
_STUFF = frozenset(_LABEL_SET.names) - frozenset(THINGS)


class StreetsConfig(Config, frozen=True):
    """A run of the suite."""

    streets: Annotated[int, msgspec.Meta(ge=1, le=20)] = 3
    split: Literal["val", "test"] = "test"
    width: Annotated[int, msgspec.Meta(ge=32)] = 352  # pixels; 1408x376 is the data set's size
    pairs: Annotated[int, msgspec.Meta(ge=2, le=PAIRS)] = PAIRS  # of images of a street
    scored_every: AtLeastOne = 4  # left image
    pseudo_miou: Fraction = 0.65  # of the predicted labels, over the scored images of a street
    moving: bool = False  # cars drive on the streets
    voxel_m: Positive = 0.25  # of fields' grids
    field_steps: AtLeastOne = 600  # of geometry and colours, and as many of all together
    field_depth: bool = True  # fields get measured depth
    seed: NotNegative = 0  # of networks


STREETS_TIERS: dict[Literal["cpu", "record"], StreetsConfig] = {
    "cpu": StreetsConfig(),
    "record": StreetsConfig(streets=10),
}


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A street with what arms get of it.

    Args:
        seed: Of the street.
        left: Left images with depth as stereo matching gives it, in order.
        right: Right images, which have neither depth nor labels.
        pseudo: (H, W) predicted ids of each left image.
        boxes: As annotated.
    """

    seed: int
    left: tuple[RoomView, ...]
    right: tuple[RoomView, ...]
    pseudo: tuple[UInt8, ...]
    boxes: tuple[StreetBox, ...]

    def frames(self) -> list[PosedFrame]:
        """Left frames in order, whose labels are the predicted ones."""
        return [replace(v.frame, label=label) for v, label in zip(self.left, self.pseudo, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What an arm says of a frame.

    Args:
        label: (H, W) ids.
        instance: (H, W) ids of things, 0 = none; None where it knows none.
        depth_m: (H, W) z, 0 = no answer; None where it knows none.
    """

    label: UInt8
    instance: NDArray[np.integer[Any]] | None = None
    depth_m: Float32 | None = None


Arm = Callable[[StreetsConfig, int], ViewScores]


def street_seeds(config: StreetsConfig) -> range:
    """The streets of a run."""
    return STREETS_SUITE.seeds[config.split][: config.streets]


def drive(config: StreetsConfig, seed: int) -> Drive:
    """A street as arms get it; they ask for the same one again and again."""
    return _drive(config.width, config.pairs, config.pseudo_miou, config.scored_every, config.moving, seed)


@lru_cache(maxsize=2)
def _drive(width: int, pairs: int, miou: float, every: int, moving: bool, seed: int) -> Drive:
    both = list(street_pairs(seed, range(pairs), street_camera(width), moving=moving))
    left = tuple(pair.left for pair in both)
    boxes = street_boxes(cached_street(seed, moving), pairs)
    return Drive(
        seed, left, tuple(pair.right for pair in both), tuple(pseudo_labels(left, seed, miou, every)), tuple(boxes)
    )


def primitives_at(boxes: Sequence[StreetBox], number: int) -> PrimitiveSet:
    """Boxes as fields take them, those that move where they are in a frame."""
    places = [b.T_world_box if b.stamps is None else b.stamps[number][1] for b in boxes]
    found = [replace(primitive(b), T_world_box=T, stamps=None) for b, T in zip(boxes, places, strict=True)]
    return PrimitiveSet(found)


def primitive(box: StreetBox) -> Primitive:
    """A box as fields take it."""
    return Primitive(
        id=box.id,
        class_name=box.name,
        shape=cast("ShapeName", box.shape),
        T_world_box=box.T_world_box,
        size=box.size,
        thing=box.thing,
        polygon=box.polygon,
        stamps=box.stamps,
    )


def pseudo_arm(config: StreetsConfig, seed: int) -> ViewScores:
    """The predicted labels themselves."""
    street = drive(config, seed)
    return score_street(config, street, lambda frame: Answer(street.pseudo[frame.seq], None, frame.depth_m))


def nearest_arm(config: StreetsConfig, seed: int) -> ViewScores:
    """The first box along each ray."""
    street = drive(config, seed)

    def answer(frame: PosedFrame) -> Answer:
        return _answer(nearest_labels(frame, primitives_at(street.boxes, frame.seq), _LABEL_SET, "sky"), frame)

    return score_street(config, street, answer)


def crf_arm(config: StreetsConfig, seed: int) -> ViewScores:
    """Boxes at the measured depth, smoothed over the predicted labels."""
    street = drive(config, seed)

    def answer(frame: PosedFrame) -> Answer:
        boxes = primitives_at(street.boxes, frame.seq)
        return _answer(box_crf(frame, boxes, street.pseudo[frame.seq], _LABEL_SET), frame)

    return score_street(config, street, answer)


ARMS: dict[str, Arm] = {"pseudo": pseudo_arm, "nearest": nearest_arm, "box-crf": crf_arm}


def _answer(found: Transferred, frame: PosedFrame) -> Answer:
    return Answer(found.label, found.instance, frame.depth_m)


def scored_views(config: StreetsConfig, street: Drive) -> list[RoomView]:
    """The left views that are scored."""
    return list(street.left[:: config.scored_every])


def score_street(config: StreetsConfig, street: Drive, answer: Callable[[PosedFrame], Answer]) -> ViewScores:
    """Scores of an arm at the scored frames, which it gets without the true labels."""
    views = scored_views(config, street)
    answers = [answer(replace(view.frame, label=None)) for view in views]
    found: dict[str, dict[int, Counts]] = {LABELS: {}, AGREEMENT: _agreements(views, answers)}
    for view, said in zip(views, answers, strict=True):
        number, truth = view.frame.seq, evaluated(view.rendered.label)
        matrix = ConfusionMatrix(_LABEL_SET)
        matrix.update(truth, said.label, f"street {street.seed}, frame {number}")
        found[LABELS][number] = matrix.counts
        if said.instance is not None:
            counts = PanopticCounts(_LABEL_SET, _STUFF)
            counts.update(PanopticImage(truth, view.rendered.instance), PanopticImage(said.label, said.instance))
            found.setdefault(PANOPTIC, {})[number] = np.rint(counts.sums * TENFOLD).astype(np.int64)
        if said.depth_m is not None:
            found.setdefault(DEPTH, {})[number] = _depth_errors(view, said.depth_m)
    return found


def evaluated(label: UInt8) -> UInt8:
    """True labels with the ignore id at classes that are not evaluated."""
    table = np.arange(256, dtype=np.uint8)
    table[[_LABEL_SET.id_of(name) for name in IGNORED]] = _LABEL_SET.ignore_id
    return table[label]


def streets_digest(config: StreetsConfig) -> str:
    """What tells records apart that were made in another way: 16 hex digits."""
    plain = to_plain(config) | {"suite_version": STREETS_SUITE.version, "record_version": RECORD_VERSION}
    del plain["streets"], plain["split"]  # records have the street's seed
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def check_streets(config: StreetsConfig) -> None:
    """Refuse settings that no run can follow. Raises ConfigError: which, and what to do."""
    if config.scored_every >= config.pairs:
        raise ConfigError(
            f"{config.pairs} pairs hold one scored image if every {config.scored_every}th is; lower scored_every"
        )


def run_streets(
    config: StreetsConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object] = bool
) -> Iterator[tuple[str, int]]:
    """Make the records that are missing in ``store``; yields arm and street before each is run.

    Raises ConfigError: settings that no run can follow.

    Args:
        config: What to run.
        arms: By name.
        store: Records that are there are kept and not made again.
        stopped: Asked before each; once it says so (anything true), the run ends.
    """
    check_streets(config)
    settings = streets_digest(config)
    jobs = ((name, seed) for seed in street_seeds(config) for name in arms)
    yield from run_missing(jobs, settings, lambda name, seed: arms[name](config, seed), store, stopped)


def streets_table(config: StreetsConfig, names: Sequence[str], store: RecordStore) -> CountTable:
    """Counts of all records that there are, by street and frame."""
    found: dict[tuple[str, str], dict[Unit, Counts]] = {}
    for name in names:
        for seed in street_seeds(config):
            record = store.find(SceneRecord, streets_digest(config), name, seed)
            for kind, number, counts in () if record is None else counts_of(record):
                found.setdefault((name, kind), {})[seed, number] = counts
    return found


def _scanned_points(view: RoomView) -> tuple[NDArray[np.int64], Float64]:
    """Flat numbers (N,) of the pixels that the scanner meets, and their points (N, 3) in the world."""
    exact = view.rendered.exact_depth_m
    met = scanned_pixels(view.frame.intrinsics) & (exact > 0) & (exact < MAX_RANGE_M)
    pixel = np.flatnonzero(met)
    points = unproject(exact, view.frame.intrinsics).reshape(-1, 3)[pixel]
    return pixel, transform(view.T_world_camera, points)


def _agreements(views: Sequence[RoomView], answers: Sequence[Answer]) -> dict[int, Counts]:
    """By the first of two frames: scanned points that both share, and how many have one class in both."""
    found = {view.frame.seq: np.zeros((1, 2), np.int64) for view in views}
    scans = [_scanned_points(view) for view in views]
    for a, b in combinations(range(len(views)), 2):
        number = views[a].frame.seq
        if views[b].frame.seq - number > MOST_APART:
            continue
        nearest = nearest_points(scans[a][1], scans[b][1], max_distance_m=SAME_POINT_M)
        shared = nearest < len(scans[b][0])
        first = answers[a].label.ravel()[scans[a][0][shared]]
        second = answers[b].label.ravel()[scans[b][0][nearest[shared]]]
        same = (first == second) & (first != _LABEL_SET.ignore_id)
        found[number] = found[number] + np.array([[same.sum(), shared.sum()]], np.int64)
    return found


def _depth_errors(view: RoomView, depth_m: Float32) -> Counts:
    """(1, 4) of the scanned pixels: sum of squared errors in cm^2, how many are answered, how many of those lie within
    a factor of 1.25, and how many there are."""
    pixel, _ = _scanned_points(view)
    true, said = view.rendered.exact_depth_m.ravel()[pixel].astype(np.float64), depth_m.ravel()[pixel]
    answered = said > 0
    true, said, asked = true[answered], said[answered].astype(np.float64), len(pixel)
    within = np.maximum(true / said, said / true) < 1.25
    square = float(np.square(100 * (said - true)).sum())
    return np.array([[round(square), len(said), within.sum(), asked]], np.int64)


def _accuracy(counts: Sequence[Float64]) -> Float64:
    return 100 * np.diagonal(counts[0], axis1=1, axis2=2).sum(axis=1) / np.maximum(counts[0].sum(axis=(1, 2)), 1)


def _quality(which: str) -> Callable[[Sequence[Float64]], Float64]:
    """One of pq, sq, rq, pq_plus from sums (B, 5, L)."""

    def value(counts: Sequence[Float64]) -> Float64:
        total, found = PanopticCounts(_LABEL_SET, _STUFF), np.zeros(len(counts[0]))
        for k, sums in enumerate(counts[0]):
            total.sums = sums / TENFOLD
            quality = getattr(total.metrics(), which)
            found[k] = np.nan if quality is None else 100 * quality
        return found

    return value


def _fraction(counts: Sequence[Float64]) -> Float64:
    return 100 * counts[0][:, 0, 0] / np.maximum(counts[0][:, 0, 1], 1)


MIOU = miou_measure("mIoU", LABELS)
ACCURACY = Measure("accuracy", (LABELS,), _accuracy)
PQ = Measure("PQ", (PANOPTIC,), _quality("pq"))
CONSISTENCY = Measure("consistency", (AGREEMENT,), _fraction)
RMSE = Measure("depth RMSE, cm", (DEPTH,), lambda c: np.sqrt(c[0][:, 0, 0] / np.maximum(c[0][:, 0, 1], 1)))
MEASURES = (
    MIOU,
    ACCURACY,
    PQ,
    Measure("SQ", (PANOPTIC,), _quality("sq")),
    Measure("RQ", (PANOPTIC,), _quality("rq")),
    Measure("PQ+", (PANOPTIC,), _quality("pq_plus")),
    CONSISTENCY,
    RMSE,
    Measure("depth within 1.25", (DEPTH,), lambda c: 100 * c[0][:, 0, 2] / np.maximum(c[0][:, 0, 1], 1)),
    Measure("depth answered", (DEPTH,), lambda c: 100 * c[0][:, 0, 1] / np.maximum(c[0][:, 0, 3], 1)),
)

CLAIMS = (
    Claim("gate: predicted labels as wanted", "", MIOU, "pseudo", least=62.0, most=68.0),
    Claim("above the predicted labels", "81.1 / 67.2", MIOU, "panoptic", "pseudo", least=8.0),
    Claim("above our map of the predicted labels", "", MIOU, "panoptic", "map", least=4.0),
    Claim(
        "above predicted labels on the grid, without boxes", "81.1 / 68.6", MIOU, "panoptic", "grid-labels", least=0.0
    ),
    Claim("learned above fixed", "81.4 / 79.4", MIOU, "panoptic", "panoptic-fixed", least=1.0),
    Claim(
        "loss of the fixed field in images brings", "81.4 / 76.9", MIOU, "panoptic", "panoptic-no-fixed-2d", least=2.0
    ),
    Claim("depth brings", "81.4 / 79.1", MIOU, "panoptic", "panoptic-no-depth", least=1.0),
    Claim("samples inside of boxes bring", "81.4 / 73.5", MIOU, "panoptic", "panoptic-uniform", least=4.0),
    Claim("loss in space brings", "81.4 / 70.7", MIOU, "panoptic", "panoptic-no-3d", least=5.0),
    Claim("0.9 of the depth error", "5.23 / 6.28 m", RMSE, "panoptic", "panoptic-no-fixed-2d", most=0.0, factor=0.9),
    Claim("PQ above boxes with a CRF", "64.4 / 62.2", PQ, "panoptic", "box-crf", least=0.0),
    Claim("more consistent than predicted labels", "95.0 / 91.8", CONSISTENCY, "panoptic", "pseudo", least=2.0),
)
