"""S-Ray taught by an IRT: from 4 labelled frames of a room, against 24 frames that an IRT of these 4 has labelled.

python -m research.experiments.taught_rooms --rooms 100000 100001 100002 --seconds 120 --out runs/taught.jsonl
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path

import msgspec
import numpy as np

from research.suites.config import SceneBudget, SuiteConfig, fit_config
from research.suites.predict import predict_view
from research.suites.protocols import Keyframes, answer_from_keyframes, choose_fitted
from research.suites.rooms import BenchmarkRoom, as_given, make_benchmark_room
from research.suites.scoring import from_rows, room_confusion
from semantic_mapper.config import IRTConfig
from semantic_mapper.evaluation.bootstrap import paired_bootstrap
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.checkpoint import adapt_model, default_checkpoint_path, load_checkpoint
from semantic_mapper.fields.irt import IRT
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.training.finetune import FinetuneConfig, finetune
from semantic_mapper.training.irt import fit_irt
from semantic_mapper.types import PosedFrame, UInt8

FRAMES, LABELLED, TAUGHT = 40, 4, 24
ROWS = ("IRT on 4", "S-Ray on 4", "S-Ray on 24 by IRT", "S-Ray on 24 true")


def suite_of(keyframes: int, seconds: float) -> SuiteConfig:
    """Forty frames of a validation room, some of them labelled."""
    scene = SceneBudget(keyframes=keyframes, unlabelled=FRAMES - keyframes, seconds=seconds)
    return SuiteConfig(split="val", protocol="finetune", scene=scene)


@dataclass(slots=True)
class Labels:
    """Label images by the number of their frame."""

    images: dict[int, UInt8]
    pixels: int = 0
    kept: int = 0
    right: int = 0

    def add(self, room: BenchmarkRoom, number: int, image: UInt8) -> None:
        """Take the labels (H, W) of a frame of the room, and count."""
        truth, kept = room.frames[number].label, image != room.label_set.ignore_id
        assert truth is not None
        self.images[number] = image
        self.pixels += truth.size
        self.kept += int(kept.sum())
        self.right += int((kept & (image == truth)).sum())


def labelled_by(field: IRT, room: BenchmarkRoom, numbers: tuple[int, ...], suite: SuiteConfig, sure: float) -> Labels:
    """Labels of frames as ``autolabel --min-confidence`` writes them, and how many pixels are right and there."""
    labels = Labels({})
    for number in numbers:
        frame = as_given(room.given[number], depth=True)
        found = predict_view(field, [frame], frame, suite.tier, room.label_set)
        kept = found.known & (found.confidence >= sure)
        labels.add(room, number, np.where(kept, found.label, room.label_set.ignore_id).astype(np.uint8))
    return labels


def run_room(seed: int, seconds: float, irt_seconds: float, sure: float) -> tuple[dict[str, ConfusionMatrix], Labels]:
    """Confusion over the query views of a room, by row."""
    suite = suite_of(LABELLED, seconds)
    room = make_benchmark_room(seed, suite)
    four = choose_fitted(room, suite)
    chosen = choose_fitted(room, suite_of(TAUGHT, seconds))
    few = [as_given(room.given[n], depth=True, label=True) for n in four.labelled]
    rest = [as_given(room.given[n], depth=True) for n in four.unlabelled]

    settings = msgspec.structs.replace(fit_config(suite, 1.0), seconds=irt_seconds)
    teacher = fit_irt([*few, *rest], room.label_set, IRT(IRTConfig(), room.label_set), settings).model.eval()
    assert isinstance(teacher, IRT)
    answers = {ROWS[0]: answer_from_keyframes(room, teacher, suite, four)}
    asked = tuple(n for n in chosen.labelled if n not in four.labelled)
    labels = labelled_by(teacher, room, asked, suite, sure)
    given = {n: as_given(room.given[n], depth=True, label=True) for n in chosen.labelled}
    taught = {n: replace(frame, label=labels.images.get(n, frame.label)) for n, frame in given.items()}
    for name, keyframes, labelled in (
        (ROWS[1], four, few),
        (ROWS[2], chosen, list(taught.values())),
        (ROWS[3], chosen, list(given.values())),
    ):
        field = taught_by(labelled, room, keyframes, fit_config(suite, 1.0))
        shown = replace_labels(room, taught) if name == ROWS[2] else room
        answers[name] = answer_from_keyframes(shown, field, suite, keyframes)
    return {name: room_confusion(room, found) for name, found in answers.items()}, labels


def taught_by(
    labelled: list[PosedFrame], room: BenchmarkRoom, keyframes: Keyframes, config: FinetuneConfig
) -> LearnedField:
    """The shipped S-Ray, finetuned on labelled frames; all others bring their images."""
    start = adapt_model(load_checkpoint(default_checkpoint_path()).model, room.label_set)
    rest = [as_given(room.given[n], depth=True) for n in keyframes.unlabelled]
    return finetune([*labelled, *rest], room.label_set, start, config).model.eval()


def replace_labels(room: BenchmarkRoom, taught: dict[int, PosedFrame]) -> BenchmarkRoom:
    """The room whose given frames have the teacher's labels: source views of a query bring them."""
    given = [replace(frame, label=taught[n].label) if n in taught else frame for n, frame in enumerate(room.given)]
    return replace(room, given=tuple(given))


def keep_and_print(
    rooms: Sequence[int],
    out: Path,
    judged: str,
    run: Callable[[int], tuple[Mapping[str, ConfusionMatrix], Labels]],
) -> None:
    """A line a room in ``out``, and a table; rooms that are there are not run again.

    Args:
        judged: The row that is compared with all others.
        run: From the seed of a room to confusions by row, and what the teacher's labels are.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    lines = out.read_text().splitlines() if out.exists() else []
    found = {record["room"]: record for record in map(json.loads, lines)}
    for seed in rooms:
        if seed in found:
            continue
        rows, labels = run(seed)
        found[seed] = {"room": seed, "kept": labels.kept / labels.pixels, "right": labels.right / max(labels.kept, 1)}
        found[seed]["rows"] = {name: matrix.counts.tolist() for name, matrix in rows.items()}
        with out.open("a") as file:
            file.write(json.dumps(found[seed]) + "\n")
    names = list(found[rooms[0]]["rows"])
    matrices = {n: [from_rows(found[s]["rows"][n]) for s in rooms] for n in names}
    print("| | " + " | ".join(str(seed) for seed in rooms) + " | all |")
    for name, parts in matrices.items():
        whole = reduce(add, parts)
        print(f"| {name} | " + " | ".join(f"{100 * (m.metrics().miou or 0):.1f}" for m in [*parts, whole]) + " |")
    for name in names if len(rooms) > 1 else ():
        if name != judged:
            change = paired_bootstrap(matrices[judged], matrices[name])
            low, high = 100 * change.low, 100 * change.high
            print(f"{judged} minus {name}: {100 * change.observed:+.1f} ({low:.1f} to {high:.1f})")
    for seed in rooms:
        kept, right = 100 * found[seed]["kept"], 100 * found[seed]["right"]
        print(f"{seed}: {kept:.1f} % of the pixels labelled, {right:.1f} % of these right")


def main() -> None:
    """A line a room in ``--out``, and a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="+", type=int, default=[100000, 100001, 100002])
    parser.add_argument("--seconds", type=float, default=120.0, help="of each S-Ray")
    parser.add_argument("--irt-seconds", type=float, default=60.0)
    parser.add_argument("--min-confidence", type=float, default=0.9)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()

    def run(seed: int) -> tuple[dict[str, ConfusionMatrix], Labels]:
        return run_room(seed, given.seconds, given.irt_seconds, given.min_confidence)

    keep_and_print(given.rooms, given.out, ROWS[2], run)


if __name__ == "__main__":
    main()
