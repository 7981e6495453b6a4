"""S-Ray taught by a Panoptic NeRF: finetuned on 24 frames of a room that it has labelled from true boxes, against the
pseudo labels that the field has learned from.

python -m research.experiments.cpu_seconds research.experiments.panoptic_taught --rooms 100000 --out runs/taught.jsonl
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from research.experiments.panoptic_rooms import predict, thing_boxes
from research.experiments.taught_rooms import Labels, keep_and_print, replace_labels, suite_of, taught_by
from research.scenes import RoomConfig, make_room
from research.suites.config import fit_config
from research.suites.protocols import answer_from_keyframes, choose_fitted
from research.suites.rooms import BenchmarkRoom, as_given, make_benchmark_room
from research.suites.scoring import room_confusion
from semantic_mapper.config import PanopticConfig
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.panoptic import Panoptic, box_config
from semantic_mapper.mapper import Mapper
from semantic_mapper.training.finetune import FinetuneConfig
from semantic_mapper.training.grid_fit import GridFitConfig
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.types import UInt8

TAUGHT = 24
BY_SRAY, BY_MAP, BY_PANOPTIC, BY_TRUTH = (
    "S-Ray on its own labels",
    "S-Ray on labels of the map",
    "S-Ray on labels of Panoptic NeRF",
    "S-Ray on true labels",
)


def pseudo_labels(room: BenchmarkRoom, numbers: list[int]) -> tuple[dict[int, UInt8], dict[int, UInt8]]:
    """Labels of frames as the shipped S-Ray makes them, and those of the map of all of these, cast back."""
    mapper = Mapper.load()
    frames = {n: as_given(room.given[n], depth=True) for n in numbers}
    single = {n: mapper.step(frame).label for n, frame in frames.items()}
    cast = {n: mapper.voxel_map.ray_cast(f.T_world_camera, f.intrinsics).label for n, f in frames.items()}
    return single, cast


def panoptic_labels(room: BenchmarkRoom, numbers: list[int], pseudo: Mapping[int, UInt8], steps: int) -> list[UInt8]:
    """Labels of frames by a field of true boxes, 10 % too large, and pseudo labels."""
    frames = [replace(as_given(room.given[n], depth=True), label=pseudo[n], label_is_pseudo=True) for n in numbers]
    config = FinetuneConfig(seconds=0, steps=steps, width=frames[0].intrinsics.width, grid=GridFitConfig(held_out=0))
    boxes = tuple(map(box_config, thing_boxes(make_room(room.seed, RoomConfig()))))
    field = fit_panoptic(frames, room.label_set, Panoptic(PanopticConfig(boxes=boxes), room.label_set), config).model
    assert isinstance(field, Panoptic)
    return [predict(field.eval(), frame).label for frame in frames]


def run_room(seed: int, seconds: float, steps: int) -> tuple[dict[str, ConfusionMatrix], Labels]:
    """Confusion over the query views of a room, by row, and the labels of Panoptic NeRF."""
    suite = suite_of(TAUGHT, seconds)
    room = make_benchmark_room(seed, suite)
    keyframes = choose_fitted(room, suite)
    numbers = sorted([*keyframes.labelled, *keyframes.unlabelled])
    single, cast = pseudo_labels(room, numbers)
    labels, true = Labels({}), Labels({})
    for n, image in zip(numbers, panoptic_labels(room, numbers, cast, steps), strict=True):
        labels.add(room, n, image)
        image = room.given[n].label
        assert image is not None
        true.add(room, n, image)
    found: dict[str, ConfusionMatrix] = {}
    by_row = {BY_SRAY: single, BY_MAP: cast, BY_PANOPTIC: labels.images, BY_TRUTH: true.images}
    for name, images in by_row.items():
        given = {n: replace(as_given(room.given[n], depth=True), label=images[n]) for n in keyframes.labelled}
        field = taught_by(list(given.values()), room, keyframes, fit_config(suite, 1.0))
        answers = answer_from_keyframes(replace_labels(room, given), field, suite, keyframes)
        found[name] = room_confusion(room, answers)
    return found, labels


def main() -> None:
    """A line a room in ``--out``, and a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="+", type=int, default=[100000, 100001, 100002])
    parser.add_argument("--seconds", type=float, default=120.0, help="of each S-Ray")
    parser.add_argument("--steps", type=int, default=600, help="of each part of the panoptic fit")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    keep_and_print(given.rooms, given.out, BY_PANOPTIC, lambda seed: run_room(seed, given.seconds, given.steps))


if __name__ == "__main__":
    main()
