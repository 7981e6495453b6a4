"""Labelled keyframes for a finetuner: which ones, and on their way to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from semantic_mapper.errors import LabelError, LogError, TransportError
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.console import FrameProgress
from semantic_mapper.nodes.launcher.running import running_launches
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.finetune_log import FinetuneRequest, FrameSource
from semantic_mapper.replay.label_folder import LabelFolder, open_label_folder
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import LabelledKeyframe
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import PosedFrame

LABELS = "labels"  # what launch files call the socket where keyframes come; see ``FinetunerOptions.labels``
DELIVERY_MS = 60_000  # that the last keyframes may take to be read, after which they are lost
SLICE_S = 0.2


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
