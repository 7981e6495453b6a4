"""Things that queries list in maps of rooms, against the things that are there.

    python -m research.experiments.things --split test    # maps of 7 s a room are kept
    python -m research.experiments.things --split fit     # and prints the figures of ``queries.instances``
    python -m research.experiments.things --map kitchen/map.npz redkitchen/mesh_labels.npz    # a real room

A piece is right where its class is that of a true thing and both overlap by at least a quarter of their union, at
surface voxels (``evaluation.instances``). A mesh has ``vertices``, their ``label`` (ids of the map) and ``instance``, 0
where nothing is known, and ``T_gravity``, which makes z up. The baseline is all pieces. Count error: for each class, by
how much the number of things in a room is off; the sum over classes.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from research.evaluation.instances import InstanceMatches
from research.evaluation.room_map import TrueSurface, kept_room, match_things
from research.suites.config import SuiteConfig, suite_seeds
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import EVEN_CONFIDENCE, EVEN_M2, LISTED, Instance

FIT_SEEDS = range(100_100, 100_140)  # in no split
IOU = 0.25
PRIOR = 0.1  # weight of the squares of what classes differ by
BINS = 5  # of certainty, for its reliability


class Piece(NamedTuple):
    """A piece of one class, and whether it is right; None = counts as wrong nowhere."""

    thing: Instance
    area_m2: float
    right: bool | None


Room = tuple[list[Piece], Counter[str]]  # what was found, by descending certainty, and the true things by class


def find_things(seed: int, suite: SuiteConfig, folder: Path) -> Room:
    """The pieces and true things of a room; its map and its true surface are kept in ``folder``."""
    saved, surface = kept_room(seed, suite, folder)
    voxel_map = VoxelMap.load(saved)
    return _judge(voxel_map, *match_things(voxel_map, surface))


def find_real_things(saved: Path, mesh: Path) -> Room:
    """The pieces in a saved map, and the things of a labelled mesh of the same room."""
    voxel_map = VoxelMap.load(saved)
    with np.load(mesh) as true:
        surface = TrueSurface(true["vertices"], true["label"], true["instance"].astype(np.int64))
        up = true["T_gravity"][2, :3].astype(np.float64)
    return _judge(voxel_map, *match_things(voxel_map, surface, voxel_map.label_set, up))


def _judge(voxel_map: VoxelMap, things: tuple[Instance, ...], matches: InstanceMatches) -> Room:
    names = dict(zip(voxel_map.label_set.ids, voxel_map.label_set.names, strict=True))
    taken, pieces = set[int](), list[Piece]()
    for thing, match in sorted(zip(things, matches.found, strict=True), key=lambda pair: -pair[0].certainty):
        right = match.iou >= IOU and match.truth not in taken
        taken |= {match.truth} if right else set()
        area = len(thing.voxels) * voxel_map.config.voxel_size_m**2
        pieces.append(Piece(thing, area, None if match.neither and not right else right))
    return pieces, Counter(names[number] for number in matches.truth)


def show(name: str, rooms: Sequence[Room], listed: Callable[[Instance], bool]) -> None:
    """Print precision, recall, F1 and count error of the pieces that count as things."""
    right, found, truth, error = Counter[str](), Counter[str](), Counter[str](), Counter[str]()
    for pieces, true_count in rooms:
        chosen = [piece for piece in pieces if piece.right is not None and listed(piece.thing)]
        count = Counter(piece.thing.class_name for piece in chosen)
        right += Counter(piece.thing.class_name for piece in chosen if piece.right)
        found, truth = found + count, truth + true_count
        error += Counter({key: abs(count[key] - true_count[key]) for key in count | true_count})
    rows = [("all", right.total(), found.total(), truth.total(), error.total())]
    rows += [(key, right[key], found[key], truth[key], error[key]) for key, _ in truth.most_common()]
    print(f"{name}, {len(rooms)} rooms, IoU {IOU}")
    for key, hits, listed_count, true, off in rows:
        p, r, f1 = hits / max(listed_count, 1), hits / max(true, 1), 2 * hits / (listed_count + true)
        print(f"  {key:14s} {true:4d} true, P {p:.3f} R {r:.3f} F1 {f1:.3f}, count error a room {off / len(rooms):.2f}")


def show_reliability(pieces: Sequence[Piece]) -> None:
    """Print how many pieces are right, by certainty."""
    certainty = np.array([piece.thing.certainty for piece in pieces])
    right = np.array([piece.right for piece in pieces], np.bool_)
    bins = np.minimum((certainty * BINS).astype(np.int64), BINS - 1)
    counts, sums, hits = (np.bincount(bins, weights, BINS) for weights in (None, certainty, right))
    for count, mean, hit in zip(counts, sums / np.maximum(counts, 1), hits / np.maximum(counts, 1), strict=True):
        print(f"  certainty {mean:.2f}: right {hit:.2f} of {count}")
    print(f"  expected calibration error {np.abs(sums - hits).sum() / len(pieces):.3f}")


def fit(pieces: Sequence[Piece]) -> None:
    """Print ``EVEN_M2``, ``CONFIDENCE_GAIN`` and ``AREA_GAIN`` of the logistic regression."""
    names = sorted(EVEN_M2)
    known = [piece for piece in pieces if piece.thing.class_name in EVEN_M2]
    of_class = torch.tensor([names.index(piece.thing.class_name) for piece in known])
    confidence, area, right = torch.tensor(
        [(p.thing.confidence - EVEN_CONFIDENCE, np.log(p.area_m2), float(bool(p.right))) for p in known]
    ).T
    shared, bias = torch.zeros(3, requires_grad=True), torch.zeros(len(names), requires_grad=True)
    optimizer = torch.optim.LBFGS([shared, bias], max_iter=500, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        logits = shared[0] * confidence + shared[1] * area + shared[2] + bias[of_class]
        value = torch.nn.functional.binary_cross_entropy_with_logits(logits, right, reduction="sum")
        value = value + PRIOR * (bias**2).sum()
        value.backward()
        return value

    optimizer.step(loss)
    gain, slope, offset = shared.tolist()
    even = np.exp(-(offset + bias.detach().numpy()) / slope).tolist()
    print({name: round(m2, 3) for name, m2 in sorted(zip(names, even, strict=True), key=lambda pair: -pair[1])})
    print(f"CONFIDENCE_GAIN {gain:.2f}, AREA_GAIN {slope:.2f}")


def main() -> None:
    """Map what is missing, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("fit", "val", "test"), default="val")
    parser.add_argument("--folder", type=Path, default=Path("runs/things"))
    parser.add_argument("--map", type=Path, nargs=2, metavar=("MAP", "MESH"))
    arguments = parser.parse_args()
    suite = SuiteConfig(split="val" if arguments.split == "fit" else arguments.split)
    seeds = FIT_SEEDS if arguments.split == "fit" else suite_seeds(suite)
    generated = (find_things(seed, suite, arguments.folder) for seed in seeds)
    rooms = [find_real_things(*arguments.map)] if arguments.map else list(generated)
    show("all pieces", rooms, lambda thing: True)
    show(f"certainty from {LISTED}", rooms, lambda thing: thing.certainty >= LISTED)
    counted = [piece for pieces, _ in rooms for piece in pieces if piece.right is not None]
    show_reliability(counted)
    if arguments.split == "fit" and not arguments.map:
        fit(counted)


if __name__ == "__main__":
    main()
