"""Which frames to label, with which classes, and which labelled ones to send to a finetuner."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import structlog

from semantic_mapper.errors import FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.weights import default_checkpoint_path
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.console import Output, frame_progress, table
from semantic_mapper.nodes.labeller.server import LabelServer, LabelSession
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.finetune_log import FinetuneRequest, FrameSource
from semantic_mapper.replay.importers.folder import read_label_set
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.label_folder import (
    LABELS_FILE,
    LabelFolder,
    make_label_folder,
    open_label_folder,
    read_classes,
)
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.training.select import Candidate, candidate_from_frame, suggest_frames
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.launches import socket_in_launch
from semantic_mapper.transport.messages import LabelledKeyframe
from semantic_mapper.transport.sockets import Publisher
from semantic_mapper.types import PosedFrame

MAX_CANDIDATES = 1000  # frames that are looked at, evenly spread over a longer log
POLL_S = 0.2
LABELS = "labels"  # what launch files call the socket where keyframes come; see ``FinetunerOptions.labels``
DELIVERY_MS = 60_000  # that the last keyframes may take to be read, after which they are lost
FINETUNER_S = 30.0  # how long the finetuner may take to be there

_log = structlog.get_logger(__name__)


class Suggested(NamedTuple):
    """Frames to label as plain data, the most useful first, and numbers of those that are labelled."""

    frames: list[dict[str, Any]]
    labelled: list[int]


def suggest(output: Output, log: Path, count: int, images: Path | None, weights: Path | None) -> None:
    """Say which frames of a log to label next."""
    if images is not None and not images.is_dir():
        raise LogError(f"--images {images}: no such folder")
    with StopRequest() as stop, frame_progress("suggest", None, stop=stop) as bar, open_log(log) as opened:
        found = suggest_for_log(opened, count, open_images(images, opened), weights, bar)
    if found.frames:
        rows = [
            (frame["number"], *("" if frame[key] is None else f"{100 * frame[key]:.1f} %" for key in ("gain", "shown")))
            for frame in found.frames
        ]
        output.print(table(rows, ("frame", "adds", "shown then")))
        if all(frame["gain"] is None for frame in found.frames):
            output.print("the frames have no depth that says what they show: these are spread evenly over time")
    else:
        output.print(f"{log.name}: its {counted(len(found.labelled), 'labelled frame')} show all that it shows")
    output.json({"log": str(log), "labelled": found.labelled, "frames": found.frames})


def serve(
    output: Output, log: Path, count: int, out: Path, classes: Path | None, weights: Path | None, port: int
) -> None:
    """Open the page to paint labels, until a stop request."""
    with StopRequest() as stop, open_log(log) as opened:
        folder = make_label_folder(out, opened, choose_classes(opened, out, classes, weights))
        with frame_progress("suggest", None, stop=stop) as bar:
            found = suggest_for_log(opened, count, open_images(out, opened), weights, bar)
        # Suggested frames in their order, then those that have labels already.
        order = list(dict.fromkeys([*(frame["number"] for frame in found.frames), *folder.numbers()])) or [0]
        with LabelServer(LabelSession(opened, folder, order), port) as server:
            output.print(f"label at {server.url}")
            output.print(
                f"  saved to {out}: learn from it with `semantic-mapper finetune {log} --labels {out} --strokes`"
            )
            while not stop:
                time.sleep(POLL_S)
        output.print(f"{out}: {counted(len(folder.numbers()), 'labelled frame')} of {log.name}")


def send(output: Output, log: Path, keyframes: int, images: Path | None, to: str) -> None:
    """Send labelled frames to a running finetuner."""
    endpoint = socket_in_launch(to, LABELS)
    with StopRequest() as stop, frame_progress("label", None, stop=stop) as bar:
        found, label_set = choose_keyframes(log, keyframes, images, bar)
        with Publisher(endpoint, policy="block", linger_ms=DELIVERY_MS) as publisher:
            if not publisher.wait_for_subscribers("keyframe", 1, FINETUNER_S, stop):
                raise KeyboardInterrupt
            for frame in found.values():
                publisher.publish(encode(LabelledKeyframe(frame, label_set, f"log {log.name}")))
    output.print(f"{counted(len(found), 'labelled keyframe')} sent: frames {', '.join(map(str, found))} of {log.name}")
    if pseudo := sum(frame.label_is_pseudo for frame in found.values()):
        output.print(f"  {pseudo} of them have pseudo labels (`autolabel`): what weights have rendered, right or wrong")


def suggest_for_log(
    log: Log, count: int, images: LabelFolder | None, weights: Path | None, monitor: JobMonitor
) -> Suggested:
    """The frames whose labels would show most surface that no labelled frame shows.

    Labelled are frames with a label image in the folder and those that the weights have learned from; and frames with
    labels of the log's own, unless all have some.

    Raises LogError: no frame can be read. WeightsError: there are no such weights. KeyboardInterrupt: a stop request
    came.
    """
    stamps = frozenset[int]() if weights is None else load_checkpoint(weights).train_stamps_ns
    painted = frozenset(() if images is None else images.numbers())
    every = -(-len(log) // MAX_CANDIDATES)
    read: list[tuple[int, int]] = []  # number in the log, and its own counter
    candidates: list[Candidate] = []
    own = set[int]()
    monitor.start(len(log))
    for number in range(len(log)):
        monitor.set(number + 1, "reading frames")
        if monitor.stopped_by:
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
        read.append((number, frame.seq))
        candidates.append(candidate_from_frame(frame))
    if not candidates:
        raise LogError(
            f"{log.path}: none of its {len(log)} frames can be used; `semantic-mapper import` of the log may help"
        )
    labelled = {i for i, c in enumerate(candidates) if read[i][0] in painted or c.stamp_ns in stamps}
    if len(own) < len(candidates):
        labelled |= own
    frames: list[dict[str, Any]] = []
    for s in suggest_frames(candidates, count, labelled):
        number, seq = read[s.index]
        stamp_ns = candidates[s.index].stamp_ns
        frames.append({"number": number, "seq": seq, "stamp_ns": stamp_ns, "gain": s.gain, "shown": s.shown})
    return Suggested(frames, sorted(read[i][0] for i in labelled))


def open_images(path: Path | None, log: Log) -> LabelFolder | None:
    """Label images that are there already; None before the first."""
    return open_label_folder(path, log) if path is not None and any(path.glob("*.png")) else None


def choose_classes(log: Log, out: Path, classes: Path | None, weights: Path | None) -> LabelSet:
    """Classes to label with: as named, or those of the folder, of named weights, of the log, of the shipped weights."""
    if classes is not None:
        return read_classes(classes)
    if (out / LABELS_FILE).exists():
        return read_label_set(out / LABELS_FILE)
    if weights is None and log.info.label_set is not None:
        return log.info.label_set
    return load_checkpoint(weights or default_checkpoint_path()).label_set


def choose_keyframes(
    path: Path, count: int, images: Path | None, monitor: JobMonitor
) -> tuple[dict[int, PosedFrame], LabelSet]:
    """Frames of a log with their labels, by their number: those with an image NNNNNN.png in the folder ``images``.

    Without images, those ``count`` of its labelled frames that together show most of what it shows.

    Raises LogError: the log, a frame or the labels of one are missing. LabelError: nobody knows what the labels mean.
    KeyboardInterrupt: a stop request came.
    """
    with open_log(path) as log:
        folder = None if images is None else open_label_folder(images, log)
        label_set = log.info.label_set if folder is None else folder.label_set
        if label_set is None:
            raise LabelError(f"{path}: has no label images; give --images with a folder that has labels.json")
        request = FinetuneRequest(path, path, keyframes=count if folder is None else 0)
        return FrameSource(log, folder, request, monitor, {}).choose_labelled(label_set, least=1), label_set
