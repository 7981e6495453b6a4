"""Weights label a log: every frame is rendered as ``map`` renders it, and a new log holds what was rendered.

All else stays as it is, byte for byte: colour images, poses, stamps, other topics, attachments, the cut into parts.
What was rendered is marked in each frame (``PosedFrame.label_is_pseudo``, ``depth_sigma_m``), and a note says by whom.
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import CodecError, ConfigError, FrameError, LabelError, LogError, WeightsError
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.files import atomic_folder, write_bytes, write_json
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import AUTOLABEL_ATTACHMENT, AutolabelNote
from semantic_mapper.replay.evaluate.things import thing_image
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import LogWriter, atomic_log
from semantic_mapper.replay.log.reader import PART_ATTACHMENT, LogReader, Part
from semantic_mapper.replay.log.sequence import Log, open_log, part_path, parts_on_disk
from semantic_mapper.replay.run_folder import prepare_folder
from semantic_mapper.transport.codec import Envelope, decode_as, encode, with_computed_depth, with_label
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float32, PosedFrame, UInt8

SCENE_RAYS = 36_000  # rendered at least for a frame by a field of the scene, or all: small images have no sharper views
DEPTH_STEPS_PER_M = 1000.0  # computed depth and its spread are rounded to millimetres, which pack to a fifth
INSTANCES_FILE = "instances.json"

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class AutolabelRequest:
    """What to label, and how."""

    logs: tuple[Path, ...]  # the log, the parts of one, or a folder with them
    out: Path  # new log; of several parts, the name of the first
    weights: Path | None = None  # none = those that ship with the package
    config: MapperConfig = field(default_factory=MapperConfig)  # of the mapper that renders
    depth: bool = False  # also give frames without depth what was computed from the pictures
    min_confidence: float = 0.0  # pixels that are less sure are unknown
    overwrite_labels: bool = False  # replace labels that are there, too
    max_frames: int = 0  # 0 = all
    # new folder for images of things, of weights that have boxes: ``CAMERA/NNNNNN.png`` (uint16 box ids, 0 = none),
    # and ``instances.json``: each thing's id, class, box, and pixels by frame ("CAMERA/NNNNNN")
    instances: Path | None = None


class AutolabelReport(NamedTuple):
    """What was written."""

    files: tuple[Path, ...]  # the new log or its parts
    note: AutolabelNote  # who has labelled it, with which figures
    unlabelled: tuple[str, ...]  # frames that could not be rendered (they are there without a label), with the reason
    damage: tuple[str, ...]  # what could not be read (and is not there)


def autolabel_log(request: AutolabelRequest, monitor: JobMonitor | None = None) -> AutolabelReport:
    """Write a new log with labels that weights have rendered; it is there once it is whole.

    Source views of a frame are those that ``map`` and ``eval`` choose: the frame itself and earlier keyframes, the
    frames that the weights were finetuned on among them. A label that is there stays, unless it is a pseudo label or
    ``overwrite_labels`` says otherwise. A frame in which nothing is sure gets none. Nothing is left of the new log, nor
    of images of things, where this raises ConfigError: the new log would lie among the parts of the old one.
    LabelError: labels stay whose classes are not those of the weights. LogError: the log cannot be read, what is to be
    written is there already or cannot be written, or no frame could be rendered. WeightsError: there are no such
    weights, or they tell no classes apart. KeyboardInterrupt: it was stopped.
    """
    monitor = monitor or JobMonitor()
    with open_log(request.logs) as log, ExitStack() as stack:
        readers = [stack.enter_context(LogReader(path, allow_empty=True)) for path in log.paths]
        if any(path.is_dir() and path.resolve() == request.out.parent.resolve() for path in request.logs):
            raise ConfigError(
                f"{request.out}: lies in the folder of the log's parts, and would be read as one; choose another folder"
            )
        there = [path for number, path in parts_on_disk(request.out).items() if number < len(readers)]
        things: Path | None = None
        if (folder := request.instances) is not None:
            there += [folder] if folder.exists() else []
        if there:
            raise LogError(f"{there[0]}: exists already; remove it or choose another name")
        mapper = _load(request, log)
        label_set = _label_set(log, mapper.label_set, request)
        mapper.voxel_map.note_scale(log.info.scale_known)
        if folder is not None:
            prepare_folder(folder.parent)
            things = stack.enter_context(atomic_folder(folder, raises=LogError))
        labeller = _Labeller(mapper, label_set, request, things)
        settings = f"{request.min_confidence} {request.overwrite_labels} {request.depth} {request.max_frames}"
        name = hashlib.sha256(f"{labeller.digest} {settings}".encode()).hexdigest()[:8]
        monitor.start(min(len(log), request.max_frames or len(log)))
        writers: list[LogWriter] = []
        for number, reader in enumerate(readers):
            if request.max_frames and labeller.count["frames"] >= request.max_frames:
                break
            writers.append(stack.enter_context(_writer(reader, part_path(request.out, number), label_set, name)))
            for envelope, parts in _messages(reader, label_set):
                if envelope.topic == "frame":
                    if monitor.stopped_by:
                        raise KeyboardInterrupt
                    if request.max_frames and labeller.count["frames"] >= request.max_frames:
                        break
                labeller.push(_Message(writers[-1], envelope, parts))
                monitor.set(labeller.count["frames"])
        labeller.finish()
        note = labeller.note()
        if not labeller.rendered:
            why = labeller.refused[0] if labeller.refused else "none can be read"
            raise LogError(f"{log.path}: none of its {counted(note.frames, 'frame')} could be rendered: {why}")
        for writer in writers:
            writer.attach(note.attachment())
            writer.flush()
        damage = tuple(str(error) for reader in readers for error in reader.errors)
        files = tuple(part_path(request.out, number) for number in range(len(writers)))
    return AutolabelReport(files, note, tuple(labeller.refused), damage)


def _load(request: AutolabelRequest, log: Log) -> Mapper:
    """Weights and the pipeline that renders them, of a field of the scene at least ``SCENE_RAYS`` of a frame."""
    mapper = Mapper.load(request.weights, request.config)
    model = mapper.model
    if not model.knows_classes or len(mapper.label_set) < 2:
        raise WeightsError(
            f"{mapper.weights_path}: a field of kind '{model.kind}' knows no classes, or one only, so that it can "
            "label nothing; give weights that were trained on labels"
        )
    if request.instances is not None and not isinstance(model, Panoptic):
        raise WeightsError(
            f"{mapper.weights_path}: a field of kind '{model.kind}' has no boxes, so that it tells no things apart; "
            "--instances goes with weights of `finetune --kind panoptic`"
        )
    if not model.holds_scene:
        return mapper
    pixels = min((k.width * k.height for k in log.info.cameras.values()), default=SCENE_RAYS)
    scale = max(request.config.render.scale, min(1.0, (SCENE_RAYS / pixels) ** 0.5))
    render = msgspec.structs.replace(request.config.render, scale=scale)
    return Mapper.load(request.weights, msgspec.structs.replace(request.config, render=render))


def _label_set(log: Log, weights: LabelSet, request: AutolabelRequest) -> LabelSet:
    """Classes of the new log: the weights', or the log's where labels of it stay."""
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


def _writer(reader: LogReader, path: Path, label_set: LabelSet, name: str) -> AbstractContextManager[LogWriter]:
    """A new log, or part of one, with what the old one keeps next to its messages."""
    kept = [a for a in reader.attachments().values() if a.name not in (PART_ATTACHMENT, AUTOLABEL_ATTACHMENT)]
    if reader.part is not None:
        kept.append(Part(f"{reader.part.recording[:64]}-{name}", reader.part.part).attachment())
    return atomic_log(path, msgspec.structs.replace(reader.info, label_set=label_set), attachments=kept)


def _messages(reader: LogReader, label_set: LabelSet) -> Iterator[tuple[Envelope, list[bytes]]]:
    """Messages of a log but for the first stream information, which the writer has written; others name the classes."""
    first = True
    for envelope, parts in reader.messages():
        if envelope.topic != "info":
            yield envelope, parts
            continue
        if not first:
            info = msgspec.structs.replace(decode_as(StreamInfo, parts), label_set=label_set)
            yield envelope, encode(info, sender=envelope.source)
        first = False


@dataclass(slots=True, eq=False)
class _Message:
    writer: LogWriter  # of the part that it belongs to
    envelope: Envelope
    parts: list[bytes]
    waits: bool = False  # for its rendering, or that of a frame before it
    number: int = -1  # of a frame in the log


class _Labeller:
    """Renders frames and writes messages in the order in which they came; frames may wait for later ones.

    ``things`` is the folder for images of things.
    """

    def __init__(self, mapper: Mapper, label_set: LabelSet, request: AutolabelRequest, things: Path | None) -> None:
        self._mapper, self._pipeline, self._request = mapper, mapper.pipeline, request
        self._ids: UInt8 = label_set.to_ids(label_set.channel_map_from(mapper.label_set))  # of the labels to write
        self._ignore_id = np.uint8(label_set.ignore_id)
        self._queue: deque[_Message] = deque()
        self._waiting: dict[tuple[str, int, int], list[_Message]] = {}
        self._pixels, self._all_pixels, self._confidence = 0, 0, 0.0
        self.digest = hashlib.sha256(mapper.weights_path.read_bytes()).hexdigest()
        self.count = dict.fromkeys(("frames", "labelled", "kept", "replaced", "unlabelled", "depth_written"), 0)
        self.rendered = 0
        self.refused: list[str] = []  # why frames could not be rendered
        self._things = things
        self._boxed = model if isinstance(model := mapper.model, Panoptic) else None
        self._thing_pixels: dict[int, dict[str, int]] = {}  # by the id of a thing, by frame

    def push(self, message: _Message) -> None:
        """Take a message."""
        self._queue.append(message)
        if message.envelope.topic == "frame":
            message.number = self.count["frames"]
            self.count["frames"] += 1
            self._push_frame(message)
        self._write_ready()

    def finish(self) -> None:
        """Write what still waits, and the list of things."""
        for frame in self._pipeline.prepare_rest():
            self._render(frame)
        self._write_ready()
        assert not self._queue, "a frame was lost on its way"
        if self._things is not None and self._boxed is not None:
            listed = [
                {"id": b.id, "class": b.class_name, "box": msgspec.to_builtins(b)}
                | {"pixels": self._thing_pixels.get(b.id, {})}
                for b in self._boxed.shape.boxes
                if b.thing
            ]
            write_json(self._things / INSTANCES_FILE, {"instances": listed})

    def note(self) -> AutolabelNote:
        """Figures so far."""
        weights, request = self._mapper.weights, self._request
        return AutolabelNote(
            weights=self._mapper.weights_path.name,
            digest=self.digest,
            kind=weights.kind,
            classes=weights.label_set.names,
            min_confidence=request.min_confidence,
            overwrite_labels=request.overwrite_labels,
            depth=request.depth,
            max_frames=request.max_frames,
            **self.count,
            mean_confidence=round(self._confidence / self._pixels, 4) if self._pixels else None,
            train_stamps_ns=tuple(sorted(weights.train_stamps_ns)),
            labelled_pixels=round(self._pixels / self._all_pixels, 4) if self._all_pixels else None,
        )

    def _push_frame(self, message: _Message) -> None:
        try:
            frame = decode_as(PosedFrame, message.parts)
            ready = self._pipeline.prepare(replace(frame, label=None, label_is_pseudo=False))
        except (CodecError, FrameError) as error:
            self._refuse(message, error)
            return
        message.waits = True
        self._waiting.setdefault((frame.camera_id, frame.stamp_ns, frame.seq), []).append(message)
        for item in ready:
            self._render(item)

    def _render(self, frame: PosedFrame) -> None:
        message = self._waiting[frame.camera_id, frame.stamp_ns, frame.seq].pop(0)
        message.waits = False
        try:
            update = self._pipeline.step(frame)
        except FrameError as error:
            self._refuse(message, error)
            return
        self.rendered += 1
        confident = update.confidence >= self._request.min_confidence
        if self._keeps(message.envelope):
            self.count["kept"] += 1
        else:
            label = self._ids[update.label]
            sure = (label != self._ignore_id) & confident
            self._set_label(message, np.where(sure, label, self._ignore_id) if sure.any() else None)
            self._pixels += int(sure.sum())
            self._all_pixels += sure.size
            self._confidence += float(update.confidence[sure].sum(dtype=np.float64))
        if self._things is not None and self._boxed is not None:
            unknown = np.uint8(self._mapper.label_set.ignore_id)
            ids = thing_image(self._boxed, frame, np.where(confident, update.label, unknown)).instance
            name = f"{frame.camera_id}/{message.number:06d}"
            path = self._things / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, cv2.imencode(".png", ids)[1].tobytes())
            for thing, count in zip(*np.unique(ids[ids > 0], return_counts=True), strict=True):
                self._thing_pixels.setdefault(int(thing), {})[name] = int(count)
        if self._request.depth and not message.envelope.has_depth and frame.depth_sigma_m is not None:
            self._add_depth(message, frame)

    def _keeps(self, envelope: Envelope) -> bool:
        """Whether a frame has a label that stays."""
        return envelope.has_label and not envelope.has_pseudo_label and not self._request.overwrite_labels

    def _set_label(self, message: _Message, label: UInt8 | None) -> None:
        envelope = message.envelope
        self.count["unlabelled" if label is None else "labelled"] += 1
        self.count["replaced"] += envelope.has_label and not envelope.has_pseudo_label
        if label is not None or envelope.has_label:
            message.parts = with_label(message.parts, label)

    def _refuse(self, message: _Message, error: Exception) -> None:
        self.refused.append(str(error))
        _log.warning("frame_not_rendered", seq=message.envelope.seq, reason=str(error))
        if self._keeps(message.envelope):
            self.count["kept"] += 1
        else:
            self._set_label(message, None)

    def _add_depth(self, message: _Message, frame: PosedFrame) -> None:
        depth_m, sigma_m = frame.depth_m, frame.depth_sigma_m
        assert depth_m is not None and sigma_m is not None
        if self._pipeline.voxel_map.scale_known:
            depth_m, sigma_m = _rounded(depth_m, np.rint), _rounded(sigma_m, np.ceil)
        if depth_m.any():
            self.count["depth_written"] += 1
            sigma_m = np.where(depth_m > 0, sigma_m, 0).astype(np.float32)
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
