"""Pseudo labels of a log against the labels of the log that it was made of.

``python -m research.experiments.pseudo_labels NEW.mcap SOURCE.mcap [--out PNG]`` prints accuracy and mIoU over
pixels that have a label in both, by classes that both logs know by name, and the fraction that pseudo labels name.
Frames that the weights were finetuned on are left out. With ``--out`` it also draws image, pseudo label and label.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import LabelSet
from semantic_mapper.plots import write_picture
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.evaluate.truth import TruthMapper
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import PosedFrame, UInt8

DRAWN = 3


def main() -> None:
    """Compare two logs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("new", type=Path)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    with open_log(given.new) as new, open_log(given.source) as source:
        labels, true_labels = new.info.label_set, source.info.label_set
        assert labels is not None and true_labels is not None, "both need labels"
        note = read_note(new.attachments())
        seen = frozenset(note.train_stamps_ns if note is not None else ())
        truth_of = TruthMapper(true_labels, labels)
        by_frame = {(e.source, e.stamp_ns): number for number, (e, _) in enumerate(source.frame_parts())}
        confusion, known, total = ConfusionMatrix(labels), 0, 0
        drawn: list[tuple[PosedFrame, UInt8]] = []
        for frame in new:
            number = by_frame.get((frame.camera_id, frame.stamp_ns))
            if number is None:
                continue
            given_frame = source.frame(number)
            if not frame.label_is_pseudo or frame.label is None or given_frame.label is None:
                continue
            drawn.append((frame, given_frame.label))
            if frame.stamp_ns in seen:
                continue
            truth = truth_of.to_map_ids(given_frame.label, f"frame seq={frame.seq}")
            # What is not named is not wrong: it counts in the fraction that is.
            named = (truth != labels.ignore_id) & (frame.label != labels.ignore_id)
            confusion.update(np.where(named, truth, np.uint8(labels.ignore_id)), frame.label, f"frame seq={frame.seq}")
            known, total = known + int(named.sum()), total + int((truth != labels.ignore_id).sum())
    found = confusion.metrics()
    assert found.miou is not None and found.total_accuracy is not None, "no frame has a pseudo label and a label"
    keyframes = sum(frame.stamp_ns in seen for frame, _ in drawn)
    print(
        f"{len(drawn)} frames with pseudo labels, of which {keyframes} are keyframes of the weights: accuracy "
        f"{found.total_accuracy * 100:.1f} %, mIoU {found.miou * 100:.1f} % of {len(truth_of.shared)} classes, "
        f"{known / max(total, 1) * 100:.1f} % of the labelled pixels are named"
    )
    if given.out is not None:
        write_picture(given.out, _sheet(drawn, labels, true_labels))


def _sheet(drawn: list[tuple[PosedFrame, UInt8]], labels: LabelSet, true_labels: LabelSet) -> UInt8:
    """A row a frame: image, pseudo label, label; classes of one name in one colour."""
    rows: list[UInt8] = []
    colors = dict(zip(labels.names, labels.colors, strict=True))
    shown = tuple(colors.get(n, c) for n, c in zip(true_labels.names, true_labels.colors, strict=True))
    true_labels = LabelSet(true_labels.name, true_labels.ids, true_labels.names, shown, true_labels.ignore_id)
    for k in np.linspace(0, len(drawn) - 1, min(DRAWN, len(drawn))).round().astype(int):
        frame, truth = drawn[k]
        assert frame.label is not None
        rows.append(np.hstack((frame.rgb, labels.colorize(frame.label), true_labels.colorize(truth))))
    return np.vstack(rows)


if __name__ == "__main__":
    main()
