"""``semantic-mapper label --suggest`` and ``--serve``: which frames to label, and the page to label them on."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from rich.table import Table

from semantic_mapper.errors import FrameError, LogError
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.console import FrameProgress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.importers.folder import read_label_set
from semantic_mapper.replay.label_folder import (
    LABELS_FILE,
    LabelFolder,
    make_label_folder,
    open_label_folder,
    read_classes,
)
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.training.select import Candidate, Suggestion, candidate_from_frame, suggest_frames

MAX_CANDIDATES = 1000  # frames that are looked at, evenly spread over a longer log

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class SuggestedFrame:
    """A frame to label: its number in the log, its own counter and stamp, and what labelling it brings."""

    number: int
    seq: int
    stamp_ns: int
    brings: Suggestion


@dataclass(frozen=True, slots=True)
class Suggested:
    """Frames to label, the most useful first, and numbers of those that are labelled."""

    frames: tuple[SuggestedFrame, ...]
    labelled: tuple[int, ...]

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        frames = [
            {"number": f.number, "seq": f.seq, "stamp_ns": f.stamp_ns, "gain": f.brings.gain, "shown": f.brings.shown}
            for f in self.frames
        ]
        return {"labelled": list(self.labelled), "frames": frames}


def suggestion_table(found: Suggested) -> Table:
    """Frames to label, best first, with what each adds to the part of the log's pixels that labelled frames show."""
    table = Table("frame", "adds", "shown then")
    for frame in found.frames:
        parts = (frame.brings.gain, frame.brings.shown)
        table.add_row(str(frame.number), *("" if part is None else f"{100 * part:.1f} %" for part in parts))
    return table


def suggest_for_log(
    log: Log, count: int, images: LabelFolder | None, weights: Path | None, stop: StopRequest, bar: FrameProgress
) -> Suggested:
    """The frames whose labels would show most surface that no labelled frame shows.

    Labelled are frames with a label image in the folder and those that the weights have learned from; and frames with
    labels of the log's own, unless all have some.

    Raises:
        LogError: no frame can be read.
        WeightsError: there are no such weights.
        KeyboardInterrupt: a stop request came.
    """
    stamps = frozenset[int]() if weights is None else load_checkpoint(weights).train_stamps_ns
    painted = frozenset(() if images is None else images.numbers())
    every = -(-len(log) // MAX_CANDIDATES)
    numbers: list[int] = []
    seqs: list[int] = []
    candidates: list[Candidate] = []
    own = set[int]()
    bar.start(len(log))
    for number in range(len(log)):
        bar.set(number + 1, "looking at frames")
        if stop:
            raise KeyboardInterrupt
        if number % every and number not in painted:
            continue
        try:
            frame = log.frame(number)
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
        except (LogError, FrameError) as error:
            _log.warning("frame_left_out", frame=number, reason=str(error))
            continue
        if frame.label is not None and not frame.label_is_pseudo:
            own.add(len(candidates))
        numbers.append(number)
        seqs.append(frame.seq)
        candidates.append(candidate_from_frame(frame))
    if not candidates:
        raise LogError(f"{log.path}: none of its {len(log)} frames can be used; `semantic-mapper recover` may help")
    labelled = {i for i, c in enumerate(candidates) if numbers[i] in painted or c.stamp_ns in stamps}
    if len(own) < len(candidates):
        labelled |= own
    found = suggest_frames(candidates, count, labelled)
    frames = (SuggestedFrame(numbers[s.index], seqs[s.index], candidates[s.index].stamp_ns, s) for s in found)
    return Suggested(tuple(frames), tuple(sorted(numbers[i] for i in labelled)))


def open_images(path: Path | None, log: Log) -> LabelFolder | None:
    """Label images that are there already; None where there are none yet.

    Raises:
        LabelError, LogError, ImportSourceError: as ``open_label_folder``.
    """
    return open_label_folder(path, log) if path is not None and any(path.glob("*.png")) else None


def choose_classes(log: Log, out: Path, classes: Path | None, weights: Path | None) -> LabelSet:
    """Classes to label with: as named, or those of the folder, of named weights, of the log, of the shipped weights.

    Raises:
        ConfigError, ImportSourceError, LabelError, WeightsError: they cannot be read.
    """
    if classes is not None:
        return read_classes(classes)
    if (out / LABELS_FILE).exists():
        return read_label_set(out / LABELS_FILE)
    if weights is None and log.info.label_set is not None:
        return log.info.label_set
    return load_checkpoint(weights or default_checkpoint_path()).label_set


def page_folder(log: Log, out: Path, classes: Path | None, weights: Path | None) -> LabelFolder:
    """The folder that the page writes to, with labels of this log or none.

    Raises:
        ConfigError, ImportSourceError, LabelError, LogError, WeightsError: as ``choose_classes`` and
            ``make_label_folder``.
    """
    return make_label_folder(out, log, choose_classes(log, out, classes, weights))


def page_order(suggested: Sequence[int], labelled: Collection[int]) -> list[int]:
    """Frames that the page shows: suggested ones in their order, then those that have labels already."""
    return [*suggested, *sorted(set(labelled) - set(suggested))]
