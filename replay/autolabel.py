"""Weights label a log: every frame is rendered as ``replay`` renders it, and a new log holds what was rendered.

All else stays as it is, byte for byte: colour images, poses, stamps, other topics, attachments, the cut into parts.
What was rendered is marked in each frame (``PosedFrame.label_is_pseudo``, ``depth_sigma_m``), and a note says by whom.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import CodecError, ConfigError, FrameError, LabelError, LogError, WeightsError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.render import render_image
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import AUTOLABEL_ATTACHMENT, AutolabelNote
from semantic_mapper.replay.instance_images import InstanceImages
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import LogWriter, atomic_log
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.log.sequence import (
    PART_ATTACHMENT,
    Log,
    LogSequence,
    Part,
    open_log,
    part_path,
    parts_on_disk,
    read_part,
)
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.transport.codec import Envelope, decode_as, encode, with_computed_depth, with_label
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float32, MapUpdate, PosedFrame, UInt8

RENDERED_SPREAD = 0.05  # one sigma of depth that a field of the scene renders, as a fraction of depth; assumed
SCENE_RAYS = 36_000  # rendered at least for a frame by a field of the scene, or all: small images have no sharper views
DEPTH_STEPS_PER_M = 1000.0  # computed depth and its spread are rounded to millimetres, which pack to a fifth

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class AutolabelRequest:
    """What to label, and how.

    Args:
        logs: The log, the parts of one, or a folder with them.
        out: New log; of several parts, the name of the first.
        weights: None = those that ship with the package.
        config: Of the mapper that renders.
        depth: Also give frames without depth what was computed or rendered.
        min_confidence: Pixels that are less sure are unknown.
        overwrite_labels: Replace labels that are there, too.
        max_frames: 0 = all.
        instances: Folder for images of things, of weights that have boxes.
    """

    logs: tuple[Path, ...]
    out: Path
    weights: Path | None = None
    config: MapperConfig = field(default_factory=MapperConfig)
    depth: bool = False
    min_confidence: float = 0.0
    overwrite_labels: bool = False
    max_frames: int = 0
    instances: Path | None = None


@dataclass(frozen=True, slots=True)
class AutolabelReport:
    """What was written.

    Args:
        files: The new log, or its parts.
        note: Who has labelled it, and the figures.
        unlabelled: Frames that could not be rendered, with the reason; they are in the new log, without a label.
        damage: What could not be read, and is not in the new log.
    """

    files: tuple[Path, ...]
    note: AutolabelNote
    unlabelled: tuple[str, ...]
    damage: tuple[str, ...]


def autolabel_log(request: AutolabelRequest, monitor: JobMonitor | None = None) -> AutolabelReport:
    """Write a new log with labels that weights have rendered; it is there once it is whole.

    Source views of a frame are those that ``replay`` and ``eval`` choose: the frame itself and earlier keyframes, the
    frames that the weights were finetuned on among them. A label that is there stays, unless it is a pseudo label or
    ``overwrite_labels`` says otherwise. A frame in which nothing is sure gets none. Weights that know no classes leave
    all labels as they are, and give depth.

    Raises:
        ConfigError: the new log would be the old one.
        LabelError: labels stay whose classes are not those of the weights.
        LogError: the log cannot be read, the new one is there already or cannot be written, or no frame could be
            rendered. Nothing is left of the new one.
        WeightsError: there are no such weights, or they tell no classes apart.
        KeyboardInterrupt: it was stopped; nothing is left of the new log, nor of images of things.
    """
    monitor = monitor or JobMonitor()
    with open_log(request.logs) as log, ExitStack() as stack:
        readers = log.logs if isinstance(log, LogSequence) else [log]
        _check_place(request, readers)
        bundle = _load(request, log)
        label_set = log.info.label_set
        if bundle.checkpoint.model.knows_classes:
            label_set = _label_set(log, bundle.label_set, request)
        else:
            _check_depth_is_missing(log, request)
        bundle.voxel_map.note_scale(log.info.scale_known)
        labeller = _Labeller(bundle, label_set, request)
        if labeller.instances is not None:
            stack.callback(labeller.instances.close)
        digest = hashlib.sha256(bundle.weights_path.read_bytes()).hexdigest()
        monitor.start(min(len(log), request.max_frames or len(log)))
        writers: list[LogWriter] = []
        for number, reader in enumerate(readers):
            if request.max_frames and labeller.frames >= request.max_frames:
                break
            name = hashlib.sha256(f"{digest} {_settings(request)}".encode()).hexdigest()[:8]
            writers.append(stack.enter_context(_writer(reader, part_path(request.out, number), label_set, name)))
            for envelope, parts in _messages(reader, label_set):
                if envelope.topic == "frame":
                    if monitor.stopped_by:
                        raise KeyboardInterrupt
                    if request.max_frames and labeller.frames >= request.max_frames:
                        break
                labeller.push(_Message(writers[-1], envelope, parts))
                monitor.set(labeller.frames)
        labeller.finish()
        note = labeller.note(digest)
        if not labeller.rendered:
            why = labeller.unlabelled[0] if labeller.unlabelled else "none can be read"
            raise LogError(f"{log.path}: none of its {counted(note.frames, 'frame')} could be rendered: {why}")
        for writer in writers:
            writer.attach(note.attachment())
            writer.flush()
        damage = tuple(str(error) for error in log.errors)
        files = tuple(part_path(request.out, number) for number in range(len(writers)))
        if labeller.instances is not None:
            labeller.instances.finish()
    return AutolabelReport(files, note, tuple(labeller.unlabelled), damage)


def _check_place(request: AutolabelRequest, readers: list[LogReader]) -> None:
    """Refuse a new log in place of a file that exists.

    Raises:
        ConfigError: it is the old one, or would be taken for a part of it.
        LogError: it is there already.
    """
    out = request.out
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder; give the name of a file")
    if out.resolve() in {reader.path.resolve() for reader in readers}:
        raise ConfigError(f"{out}: is the log itself; choose another name for the new one")
    if any(path.is_dir() and path.resolve() == out.parent.resolve() for path in request.logs):
        raise ConfigError(
            f"{out}: lies in the folder of the log's parts, and would be read as one; choose another folder"
        )
    there = [out] if out.exists() else []
    if len(readers) > 1:
        there += parts_on_disk(out).values()
    if there:
        raise LogError(f"{there[0]}: exists already; remove it or choose another name")


def _load(request: AutolabelRequest, log: Log) -> Mapper:
    """Weights and the pipeline that renders them, of a field of the scene at least ``SCENE_RAYS`` of a frame.

    Raises:
        WeightsError: missing, damaged, or they tell no classes apart.
    """
    bundle = Mapper.load(request.weights, request.config)
    model = bundle.checkpoint.model
    if model.knows_classes and len(bundle.label_set) < 2:
        raise WeightsError(
            f"{bundle.weights_path}: knows one class only ({bundle.label_set.names[0]}), so that there is nothing to "
            "label; give weights that were trained on labels"
        )
    if not model.knows_classes and (request.overwrite_labels or not request.depth):
        raise WeightsError(
            f"{bundle.weights_path}: a field of kind '{model.kind}' knows no classes, so that it can label nothing; "
            "with --depth, and without --overwrite-labels, it gives frames the depth that it renders. For labels give "
            "weights that were trained on some"
        )
    if request.instances is not None and not isinstance(model, Panoptic):
        raise WeightsError(
            f"{bundle.weights_path}: a field of kind '{model.kind}' has no boxes, so that it tells no things apart; "
            "--instances goes with weights of `finetune --kind panoptic`"
        )
    if not model.holds_scene:
        return bundle
    config = request.config
    if request.depth and config.depth.source == "auto":
        depth = msgspec.structs.replace(config.depth, source="sensor")  # else the field renders
        config = msgspec.structs.replace(config, depth=depth)
    pixels = min((k.width * k.height for k in log.info.cameras.values()), default=SCENE_RAYS)
    scale = max(config.render.scale, min(1.0, (SCENE_RAYS / pixels) ** 0.5))
    render = msgspec.structs.replace(config.render, scale=scale)
    return Mapper.load(request.weights, msgspec.structs.replace(config, render=render))


def _label_set(log: Log, weights: LabelSet, request: AutolabelRequest) -> LabelSet:
    """Classes of the new log: the weights', or the log's where labels of it stay.

    Raises:
        LabelError: labels stay, and have other classes.
    """
    there = log.info.label_set
    if there is None or request.overwrite_labels:
        return weights
    if not any(envelope.has_label and not envelope.has_pseudo_label for envelope, _ in log.frame_parts()):
        return weights
    if sorted(there.names) != sorted(weights.names):
        raise LabelError(
            f"{log.path}: its labels have other classes than the weights, and one log has one set: '{there.name}' "
            f"({', '.join(there.names)}), and the weights '{weights.name}' ({', '.join(weights.names)}). Give weights "
            "that were finetuned on its labels, replace all labels with --overwrite-labels, or import it with --rename"
        )
    return there


def _check_depth_is_missing(log: Log, request: AutolabelRequest) -> None:
    """Weights without classes have something to do only where a frame lacks depth.

    Raises:
        LogError: none does.
    """
    frames = islice(log.frame_parts(), request.max_frames or None)
    if all(envelope.has_depth for envelope, _ in frames):
        raise LogError(f"{log.path}: no frame lacks depth, and these weights know no classes: nothing was rendered")


def _settings(request: AutolabelRequest) -> str:
    return f"{request.min_confidence} {request.overwrite_labels} {request.depth} {request.max_frames}"


def _writer(reader: LogReader, path: Path, label_set: LabelSet | None, name: str) -> AbstractContextManager[LogWriter]:
    """A new log, or part of one, with what the old one keeps next to its messages."""
    kept = [a for a in reader.attachments().values() if a.name not in (PART_ATTACHMENT, AUTOLABEL_ATTACHMENT)]
    if (part := read_part(reader)) is not None:
        kept.append(Part(f"{part.recording[:64]}-{name}", part.part).attachment())
    return atomic_log(path, _labelled_info(reader.info, label_set), attachments=kept)


def _labelled_info(info: StreamInfo, label_set: LabelSet | None) -> StreamInfo:
    return msgspec.structs.replace(info, label_set=label_set)


def _messages(reader: LogReader, label_set: LabelSet | None) -> Iterator[tuple[Envelope, list[bytes]]]:
    """Messages of a log but for the first stream information, which the writer has written; others name the classes."""
    first = True
    for envelope, parts in reader.messages():
        if envelope.topic != "info":
            yield envelope, parts
            continue
        if not first:
            info = _labelled_info(decode_as(StreamInfo, parts), label_set)
            yield envelope, encode(info, sender=envelope.source)
        first = False


@dataclass(slots=True, eq=False)
class _Message:
    """A message on its way to the new log.

    Args:
        writer: Of the part that it belongs to.
        envelope, parts: Of the message.
        waits: For its rendering, or that of a frame before it.
        number: Of a frame in the log.
    """

    writer: LogWriter
    envelope: Envelope
    parts: list[bytes]
    waits: bool = False
    number: int = -1

    @property
    def key(self) -> tuple[str, int, int]:
        """Of a frame."""
        return self.envelope.source, self.envelope.stamp_ns, self.envelope.seq


class _Labeller:
    """Renders frames and writes messages in the order in which they came; frames may wait for later ones.

    Args:
        bundle: What renders.
        label_set: Of the labels to write; None = no labels are written.
        request: What is requested.
    """

    def __init__(self, bundle: Mapper, label_set: LabelSet | None, request: AutolabelRequest) -> None:
        self._bundle = bundle
        self._pipeline: MappingPipeline = bundle.pipeline
        self._request = request
        label_set = label_set or bundle.label_set
        self._labels = bundle.checkpoint.model.knows_classes
        if self._labels:
            self._ids: UInt8 = label_set.to_ids(label_set.channel_map_from(bundle.label_set))
        self._ignore_id = label_set.ignore_id
        self._no_class = np.uint8(bundle.label_set.ignore_id)
        self._queue: deque[_Message] = deque()
        self._waiting: dict[tuple[str, int, int], deque[_Message]] = {}
        self._pixels, self._all_pixels, self._confidence = 0, 0, 0.0
        self.frames = self.rendered = self.labelled = self.kept = self.replaced = self.depth_written = 0
        self.without = 0
        self.unlabelled: list[str] = []
        model = bundle.checkpoint.model
        self.instances = (
            None
            if request.instances is None or not isinstance(model, Panoptic)
            else InstanceImages(request.instances, model)
        )

    def push(self, message: _Message) -> None:
        """Take a message.

        Raises:
            LogError: the disk is full.
            MapError: the map that depth is rendered from is full.
        """
        self._queue.append(message)
        if message.envelope.topic == "frame":
            message.number = self.frames
            self.frames += 1
            self._push_frame(message)
        self._write_ready()

    def finish(self) -> None:
        """Write what still waits.

        Raises:
            LogError, MapError: as ``push``.
        """
        for frame in self._pipeline.prepare_rest():
            self._render(frame)
        self._write_ready()
        assert not self._queue, "a frame was lost on its way"

    def note(self, digest: str) -> AutolabelNote:
        """Figures so far."""
        checkpoint, request = self._bundle.checkpoint, self._request
        return AutolabelNote(
            weights=self._bundle.weights_path.name,
            digest=digest,
            kind=checkpoint.model.kind,
            classes=checkpoint.label_set.names if self._labels else (),
            min_confidence=request.min_confidence,
            overwrite_labels=request.overwrite_labels,
            depth=request.depth,
            max_frames=request.max_frames,
            frames=self.frames,
            labelled=self.labelled,
            kept=self.kept,
            replaced=self.replaced,
            unlabelled=self.without,
            depth_written=self.depth_written,
            mean_confidence=round(self._confidence / self._pixels, 4) if self._pixels else None,
            train_stamps_ns=tuple(sorted(checkpoint.train_stamps_ns)),
            labelled_pixels=round(self._pixels / self._all_pixels, 4) if self._all_pixels else None,
        )

    def _push_frame(self, message: _Message) -> None:
        try:
            frame = decode_as(PosedFrame, message.parts)
            message.waits = True
            self._waiting.setdefault(message.key, deque()).append(message)
            ready = self._pipeline.prepare(replace(frame, label=None, label_is_pseudo=False))
        except (CodecError, FrameError) as error:
            if message.waits:
                self._taken(message.key, last=True)
            self._refuse(message, error)
            return
        for item in ready:
            self._render(item)

    def _render(self, frame: PosedFrame) -> None:
        message = self._taken((frame.camera_id, frame.stamp_ns, frame.seq))
        if not self._labels:
            self._add_only_depth(message, frame)
            return
        try:
            update = self._pipeline.step(frame)
        except FrameError as error:
            self._refuse(message, error)
            return
        self.rendered += 1
        self._label(message, self._ids[update.label], update.confidence)
        if self.instances is not None:
            self.instances.add(message.number, frame, np.where(self._sure(update), update.label, self._no_class))
        if self._request.depth and not message.envelope.has_depth:
            self._add_depth(message, frame, update.depth_m)

    def _add_only_depth(self, message: _Message, frame: PosedFrame) -> None:
        """What a field without classes gives."""
        self.rendered += 1
        self.kept += message.envelope.has_label
        self.without += not message.envelope.has_label
        if not message.envelope.has_depth:
            checkpoint = self._bundle.checkpoint
            self._add_depth(message, frame, rendered_depth(checkpoint.model, frame, checkpoint.width))

    def _taken(self, key: tuple[str, int, int], *, last: bool = False) -> _Message:
        """The message of a frame, which waits no more."""
        waiting = self._waiting[key]
        message = waiting.pop() if last else waiting.popleft()
        if not waiting:
            del self._waiting[key]
        message.waits = False
        return message

    def _keeps(self, envelope: Envelope) -> bool:
        """Whether a frame has a label that stays."""
        if not self._labels:
            return envelope.has_label
        return envelope.has_label and not envelope.has_pseudo_label and not self._request.overwrite_labels

    def _label(self, message: _Message, label: UInt8, confidence: Float32) -> None:
        if self._keeps(message.envelope):
            self.kept += 1
            return
        sure = (label != self._ignore_id) & (confidence >= self._request.min_confidence)
        found = np.where(sure, label, np.uint8(self._ignore_id))
        self._set_label(message, found if sure.any() else None)
        self._pixels += int(sure.sum())
        self._all_pixels += sure.size
        self._confidence += float(confidence[sure].sum(dtype=np.float64))

    def _sure(self, update: MapUpdate) -> NDArray[np.bool_]:
        return update.confidence >= self._request.min_confidence

    def _set_label(self, message: _Message, label: UInt8 | None) -> None:
        envelope = message.envelope
        self.labelled += label is not None
        self.without += label is None
        self.replaced += envelope.has_label and not envelope.has_pseudo_label
        if label is not None or envelope.has_label:
            message.parts = with_label(message.parts, label)

    def _refuse(self, message: _Message, error: Exception) -> None:
        self.unlabelled.append(str(error))
        _log.warning("frame_not_rendered", seq=message.envelope.seq, reason=str(error))
        if self._keeps(message.envelope):
            self.kept += 1
        else:
            self._set_label(message, None)

    def _add_depth(self, message: _Message, frame: PosedFrame, rendered_m: Float32) -> None:
        if frame.depth_sigma_m is not None and frame.depth_m is not None:
            depth_m, sigma_m = frame.depth_m, frame.depth_sigma_m
        elif self._bundle.checkpoint.model.holds_scene:
            depth_m, sigma_m = rendered_m, np.float32(RENDERED_SPREAD) * rendered_m
        else:
            return
        if self._pipeline.voxel_map.scale_known:
            depth_m, sigma_m = _rounded(depth_m, np.rint), _rounded(sigma_m, np.ceil)
        sigma_m = np.where(depth_m > 0, sigma_m, 0).astype(np.float32)
        if depth_m.any():
            self.depth_written += 1
            message.parts = with_computed_depth(message.parts, depth_m, sigma_m)

    def _write_ready(self) -> None:
        while self._queue and not self._queue[0].waits:
            message = self._queue.popleft()
            message.writer.write_parts(message.parts)


def _rounded(metres: Float32, how: Callable[[Float32], Float32]) -> Float32:
    """In whole millimetres of uint16; what is beyond becomes 0."""
    steps = how(metres * np.float32(DEPTH_STEPS_PER_M))
    held = np.where(np.isfinite(steps) & (steps >= 0) & (steps <= np.iinfo(np.uint16).max), steps, 0)
    return held.astype(np.float32) / np.float32(DEPTH_STEPS_PER_M)


# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false


OPAQUE = 0.5  # opacity from which on a ray has met a surface


def rendered_depth(field: LearnedField, frame: PosedFrame, width: int) -> Float32:
    """z (H, W) in metres at the size of the frame, 0 where a ray meets nothing.

    Args:
        field: Holds the scene.
        frame: Pose and camera.
        width: Of the rendering, in pixels; each pixel of the frame has the nearest one.
    """
    k = working_intrinsics(frame.intrinsics, width)
    sources = field.encode(stack_sources([view_from_frame(frame, field.label_set, k.width)]))
    nothing = np.zeros((k.height, k.width), np.float32)
    scene = (field, sources, k, frame.T_world_camera, nothing, field.sampling, 0)
    found = render_image(*scene, stamp_ns=frame.stamp_ns)
    depth = (found.depth_m * (found.opacity > OPAQUE)).view(k.height, k.width).numpy()
    size = (frame.intrinsics.width, frame.intrinsics.height)
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
