"""How well a map's instances are the true ones: average precision, as ScanNet reckons it.

Everything is counted in surface voxels that have a truth. A found instance is right where its class is that of a true
one and both overlap by at least ``iou`` of their union; of several that overlap one, the surest counts. Found
instances of which most lies on true ones that are too small to count, or on voxels without a truth, are neither right
nor wrong. Average precision is the area under precision over recall, found instances sorted by their confidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, UInt8

MIN_VOXELS = 30  # smaller true instances do not count; smaller pieces are not instances (``queries.instances``)
IOU = 0.5
NEITHER = 0.5  # most of a found instance that may lie where nothing counts


class InstanceMatch(NamedTuple):
    """A found instance.

    Args:
        class_id: Its class.
        confidence: 0..1.
        iou: With the true instance of its class that it overlaps most; 0 = with none.
        truth: Number of that, among those of the map; -1 = none.
        neither: Whether it counts as wrong nowhere.
    """

    class_id: int
    confidence: float
    iou: float
    truth: int
    neither: bool


@dataclass(frozen=True, slots=True)
class InstanceMatches:
    """Of one map: what was found, and the class ids of the true instances."""

    found: tuple[InstanceMatch, ...]
    truth: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class InstanceFigures:
    """Figures in 0..1; None where there was no true instance.

    Args:
        ap: Mean over the classes in the truth of their average precision.
        per_class: That of each, by name.
        recall: Fraction of all true instances that were found.
        precision: Fraction of all found instances that are right.
        truth: True instances.
    """

    ap: float | None
    per_class: dict[str, float] = field(default_factory=dict[str, float])
    recall: float | None = None
    precision: float | None = None
    truth: int = 0


class FoundInstances(NamedTuple):
    """What a map says of N surface voxels: instance (N,) from 0, -1 = none; and of each of the I instances, its class
    id (I,) and confidence (I,)."""

    instance: NDArray[np.int64]
    class_id: UInt8
    confidence: Float32


def match_instances(
    found: FoundInstances,
    true_label: UInt8,
    true_instance: NDArray[np.int64],
    label_set: LabelSet,
    stuff: frozenset[str],
    *,
    min_voxels: int = MIN_VOXELS,
) -> InstanceMatches:
    """Find the true instance of each found one.

    Args:
        found: Of N voxels.
        true_label: (N,) ids; the ignore id where there is no truth.
        true_instance: (N,) number of the object of each.
        label_set: Of the ids.
        stuff: Names of classes that are no things.
        min_voxels: Smaller true instances do not count.
    """
    known = true_label != label_set.ignore_id
    thing = np.isin(true_label, label_set.thing_ids(stuff))
    key = np.where(thing, true_label.astype(np.int64) << 32 | true_instance, -1)
    keys, number = np.unique(key, return_inverse=True)
    number = number.reshape(-1)
    size = np.bincount(number, minlength=len(keys))
    counts = (keys >= 0) & (size >= min_voxels)
    order = np.cumsum(counts) - 1

    count, true = len(found.class_id), len(keys)
    pairs = found.instance[found.instance >= 0] * true + number[found.instance >= 0]
    known_pairs = pairs[known[found.instance >= 0]]
    overlap = np.bincount(known_pairs, minlength=count * true).reshape(count, true)
    whole = np.bincount(found.instance[found.instance >= 0], minlength=count)
    of_class = (keys >> 32)[None] == found.class_id[:, None]
    union = overlap.sum(axis=1)[:, None] + size[None] - overlap
    iou = np.where(of_class & counts, overlap / np.maximum(union, 1), 0)
    small = np.where(of_class & ~counts & (keys >= 0), overlap, 0).sum(axis=1)
    neither = (small + whole - overlap.sum(axis=1)) > NEITHER * np.maximum(whole, 1)
    matches: list[InstanceMatch] = []
    for n in range(count):
        best = int(iou[n].argmax()) if true else 0
        reached = float(iou[n, best]) if true else 0.0
        truth = int(order[best]) if reached > 0 else -1
        matches.append(
            InstanceMatch(int(found.class_id[n]), float(found.confidence[n]), reached, truth, bool(neither[n]))
        )
    return InstanceMatches(tuple(matches), tuple(int(c) for c in keys[counts] >> 32))


def average_precision(maps: Sequence[InstanceMatches], label_set: LabelSet, iou: float = IOU) -> InstanceFigures:
    """Figures over all instances of some maps."""
    per_class: dict[str, float] = {}
    right = found = truth = 0
    for class_id, name in zip(label_set.ids, label_set.names, strict=True):
        true = sum(map_.truth.count(class_id) for map_ in maps)
        if not true:
            continue
        hits = _right(maps, class_id, iou)
        precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
        best = np.maximum.accumulate(precision[::-1])[::-1]
        per_class[name] = float((best * hits).sum() / true)
        right, found, truth = right + int(hits.sum()), found + len(hits), truth + true
    if not truth:
        return InstanceFigures(None)
    return InstanceFigures(
        float(np.mean(list(per_class.values()))), per_class, right / truth, right / found if found else None, truth
    )


def _right(maps: Sequence[InstanceMatches], class_id: int, iou: float) -> NDArray[np.int64]:
    """Whether each found instance of a class is right (0 or 1), the surest first."""
    listed = [
        (-match.confidence, number, match)
        for number, map_ in enumerate(maps)
        for match in map_.found
        if match.class_id == class_id and (match.iou >= iou or not match.neither)
    ]
    taken: set[tuple[int, int]] = set()
    hits: list[int] = []
    for _, number, match in sorted(listed, key=lambda entry: entry[:2]):
        new = match.iou >= iou and (number, match.truth) not in taken
        if new:
            taken.add((number, match.truth))
        hits.append(int(new))
    return np.array(hits, np.int64)
