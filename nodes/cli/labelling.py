"""Which frames to label, the folder that the page writes to, and labelled keyframes on their way to a finetuner."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import structlog
from rich.table import Table

from semantic_mapper.errors import FrameError, LabelError, LogError, TransportError
from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.console import FrameProgress
from semantic_mapper.nodes.launcher.running import running_launches
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.finetune_log import FinetuneRequest, FrameSource
from semantic_mapper.replay.importers.folder import read_label_set
from semantic_mapper.replay.label_folder import (
    LABELS_FILE,
    LabelFolder,
    make_label_folder,
    open_label_folder,
    read_classes,
)
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.training.select import Candidate, Suggestion, candidate_from_frame, suggest_frames
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import PosedFrame

LABELS = "labels"  # what launch files call the socket where keyframes come; see ``FinetunerOptions.labels``
DELIVERY_MS = 60_000  # that the last keyframes may take to be read, after which they are lost
SLICE_S = 0.2
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
        bar.set(number + 1, "reading frames")
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
        raise LogError(
            f"{log.path}: none of its {len(log)} frames can be used; `semantic-mapper import` of the log may help"
        )
    labelled = {i for i, c in enumerate(candidates) if numbers[i] in painted or c.stamp_ns in stamps}
    if len(own) < len(candidates):
        labelled |= own
    found = suggest_frames(candidates, count, labelled)
    frames = (SuggestedFrame(numbers[s.index], seqs[s.index], candidates[s.index].stamp_ns, s) for s in found)
    return Suggested(tuple(frames), tuple(sorted(numbers[i] for i in labelled)))


def open_images(path: Path | None, log: Log) -> LabelFolder | None:
    """Label images that are there already; None before the first.

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


def choose_keyframes(
    path: Path, count: int, frames: Iterable[int], images: Path | None, stop: StopRequest, bar: FrameProgress
) -> tuple[dict[int, PosedFrame], LabelSet]:
    """Frames of a log with their labels, by their number in it.

    Args:
        path: The log.
        count: Of its labelled frames, this many that together show most of what it shows, where nothing names others.
        frames: By number in the log.
        images: Folder of label images NNNNNN.png in place of the log's, each named by the number of its frame, with a
            labels.json or in the log's classes; without ``frames``, those are meant that have one.
        stop: Ends it.
        bar: Shows how far it is.

    Raises:
        LogError: the log, a frame or the labels of one are missing.
        LabelError: nobody knows what the labels mean.
        ImportSourceError: a labels.json that is not of a label folder.
        KeyboardInterrupt: a stop request came.
    """
    with open_log(path) as log:
        folder = None if images is None else open_label_folder(images, log)
        label_set = log.info.label_set if folder is None else folder.label_set
        if label_set is None:
            raise LabelError(f"{path}: has no label images; give --images with a folder that has labels.json")
        numbers = sorted(set(frames)) or ([] if folder is None else folder.numbers())
        if folder is None and not numbers:
            request = FinetuneRequest(path, path, keyframes=count)
            return FrameSource(log, None, request, {}).choose_labelled(label_set, bar), label_set
        bar.start(len(numbers))
        chosen: dict[int, PosedFrame] = {}
        for number in numbers:
            if stop:
                raise KeyboardInterrupt
            if number >= len(log):
                raise LogError(f"{path}: has no frame {number}; it has {len(log)}")
            chosen[number] = _labelled(log.frame(number), number, folder, path)
            bar.advance()
    return chosen, label_set


def labels_endpoint(place: str) -> str:
    """Where a finetuner listens.

    Args:
        place: An endpoint, or the socket folder of a launch; empty = that of the one launch that runs.

    Raises:
        TransportError: none runs, or several do.
    """
    if "://" in place:
        return place
    folders = [Path(place).absolute()] if place else running_launches()
    if len(folders) != 1:
        which = f"several launches run: {', '.join(map(str, folders))}" if folders else "no launch runs here"
        raise TransportError(f"{which}; say with --to where the finetuner listens (its option `labels`)")
    return f"ipc://{folders[0]}/{LABELS}"


@contextmanager
def sending(endpoint: str, timeout_s: float, stop: StopRequest) -> Iterator[Callable[[LabelledKeyframe], None]]:
    """What sends keyframes, once a finetuner is there.

    Raises:
        TransportError: none within the time, or another labelling tool is at work there.
        KeyboardInterrupt: a stop request came.
    """
    with Publisher(endpoint, policy="block", linger_ms=DELIVERY_MS) as publisher:
        waited = 0.0
        while not publisher.subscribers("keyframe"):
            if stop:
                raise KeyboardInterrupt
            if waited > timeout_s:
                raise TransportError(f"{endpoint}: no finetuner listens there (waited {timeout_s:g} s); does one run?")
            _wait(publisher, SLICE_S)
            waited += SLICE_S
        yield lambda keyframe: publisher.publish(encode(keyframe))


def _wait(publisher: Publisher, seconds: float) -> None:
    try:
        publisher.wait_for_subscribers("keyframe", timeout_s=seconds)
    except TransportError:
        return


def _labelled(frame: PosedFrame, number: int, folder: LabelFolder | None, path: Path) -> PosedFrame:
    if folder is not None:
        return folder.labelled(frame, number)
    if frame.label is None:
        raise LogError(f"{path}: frame {number} has no label image; give one in a folder with --images")
    return frame
