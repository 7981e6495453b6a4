"""Finetuning on a log: choose keyframes, train, write the weights.

Kinds of fields that are fitted to one scene take the other frames, too; "panoptic" takes all frames with pseudo labels:
of a folder, of weights, or the log's own images.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np

from semantic_mapper.config import DepthConfig, MapperConfig, PanopticConfig, VoxelMapConfig
from semantic_mapper.errors import ConfigError, FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.fields.scene.panoptic import Panoptic, box_config
from semantic_mapper.fields.weights import anchor_from_frame, default_checkpoint_path
from semantic_mapper.geometry import check_pose
from semantic_mapper.imaging import resize_depth, resize_spread, working_intrinsics
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.frame_depth import FrameDepth
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.boxes import QUERY_MARGIN_M, load_boxes, with_classes
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.label_folder import LabelFolder, open_label_folder
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.replay.run_folder import prepare_file
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.finetune import FITTERS, finetune
from semantic_mapper.training.fit import FitProgress
from semantic_mapper.training.panoptic import boxes_in_view
from semantic_mapper.training.select import Candidate, candidate_from_frame, choose_keyframes
from semantic_mapper.training.strokes import grow_strokes, labelled_fraction
from semantic_mapper.training.views import usable_frames
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

FrameKey = tuple[str, int]  # camera and stamp
ItemT = TypeVar("ItemT")
MAX_SCENE_FRAMES = 300  # that a field of one scene is fitted to
_log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class FinetuneRequest:
    """What to finetune, and on what."""

    log: Path
    out: Path  # weights to write
    # how many labelled frames to use; 0 for a kind that learns no classes, and for all frames that the folder
    # ``labels`` has labels of
    keyframes: int = 0
    config: FinetuneConfig = field(default_factory=FinetuneConfig)  # of the training
    weights: Path | None = None  # to start from; None = those in the package
    # where the frames' depth comes from
    depth: DepthConfig = field(default_factory=lambda: DepthConfig(source="sensor"))
    kind: str | None = None  # of a field that is fitted to one scene, from nothing; None = that of the weights
    labels: Path | None = None  # folder of label images in place of the log's
    boxes: Path | None = None  # kind "panoptic": file of boxes
    pseudo: str | None = None  # kind "panoptic": folder or weights of pseudo labels
    uncovered: str = "stuff"  # kind "panoptic": what is outside of all boxes
    strokes: bool = False  # label images are strokes, and grow


def finetune_log(request: FinetuneRequest, monitor: JobMonitor | None = None) -> tuple[Checkpoint, list[int]]:
    """Finetune on keyframes of a log and write the weights: after a stop request, the best so far. Returns them
    (``recipe`` holds the figures), and the numbers in the log of the labelled frames.

    Raises LogError, LabelError, FrameError, WeightsError, ConfigError: with what is wrong, and what to do.
    KeyboardInterrupt: a stop request came before anything was learned.
    """
    monitor = monitor or JobMonitor()
    if request.out.resolve() == request.log.resolve():
        raise ConfigError(f"{request.out}: is the log itself; choose another name for the weights")
    if request.out.is_file() and request.out.suffix != ".safetensors":
        raise ConfigError(f"{request.out}: is there, and no weights file; give --out a name that ends in .safetensors")
    prepare_file(request.out)
    made = _finetune_labels(request, monitor) if request.boxes is None else _finetune_boxes(request, monitor)
    save_checkpoint(made[0], request.out)
    return made


def _finetune_labels(request: FinetuneRequest, monitor: JobMonitor) -> tuple[Checkpoint, list[int]]:
    # First, so that a wrong path does not cost the reading of a log.
    start = None if request.kind else load_checkpoint(request.weights or default_checkpoint_path())
    kind = str(request.kind) if start is None else start.model.kind
    if request.config.irt.variant is not None and kind != IRT.kind:
        raise ConfigError(f"irt.variant: goes with weights of kind 'irt', not with '{kind}'; leave it out")
    with open_log(request.log) as log:
        folder = None if request.labels is None else open_label_folder(request.labels, log)
        label_set = log.info.label_set if folder is None else folder.label_set
        if label_set is None and request.keyframes:
            raise LabelError(
                f"{request.log}: has no label images; finetuning needs labelled keyframes. Make some with "
                "`semantic-mapper label LOG --serve`, and give their folder with --labels"
            )
        label_set = label_set or ROOMS
        source = FrameSource(log, folder, request, monitor, _compute_depths(log, request.depth, monitor))
        by_number: dict[int, PosedFrame] = {}
        if request.keyframes or folder is not None:  # a folder without a number: all that it has
            by_number = source.choose_labelled(label_set)
        frames = list(by_number.values())
        recipe: dict[str, Any] = {}
        note = read_note(log.attachments())
        if pseudo := sum(f.label_is_pseudo for f in frames):
            recipe["pseudo_labels"] = {"keyframes": pseudo, "of": "" if note is None else note.weights}
        if request.strokes:
            painted = labelled_fraction(frames, label_set)
            frames = [grow_strokes(frame, label_set) for frame in frames]
            recipe["strokes"] = {"painted": painted, "grown": labelled_fraction(frames, label_set)}
        if kind in FITTERS:
            frames += source.unlabelled(frames)
    model, seen = (None, frozenset[int]()) if start is None else (start.model, start.train_stamps_ns)
    if note is not None and any(f.label_is_pseudo for f in frames):
        seen |= frozenset(note.train_stamps_ns)  # who learns from a teacher has learned from its keyframes
    checkpoint = _fit(request, monitor, frames, label_set, model, seen, kind)
    checkpoint.recipe.update(recipe)
    return checkpoint, list(by_number)


def _finetune_boxes(request: FinetuneRequest, monitor: JobMonitor) -> tuple[Checkpoint, list[int]]:
    assert request.boxes is not None
    boxes = load_boxes(request.boxes, query_margin_m=QUERY_MARGIN_M)
    with open_log(request.log) as log:
        labels = open_pseudo_labels(log, request.pseudo)
        boxes, label_set = with_classes(boxes, labels.label_set, request.boxes, labels.source)
        source = FrameSource(log, None, request, monitor, _compute_depths(log, request.depth, monitor))
        frames = source.pseudo_labelled(labels)
        note = read_note(log.attachments())
    in_view = boxes_in_view(boxes.primitives, usable_frames(frames))
    config = PanopticConfig(
        boxes=tuple(box_config(p) for p, there in zip(boxes.primitives, in_view, strict=True) if there),
        merge=dict(boxes.merge),
        uncovered="empty" if request.uncovered == "empty" else "stuff",
    )
    seen = labels.train_stamps_ns
    if note is not None and any(f.label_is_pseudo for f in frames):
        seen |= frozenset(note.train_stamps_ns)
    checkpoint = _fit(request, monitor, frames, label_set, Panoptic(config, label_set), seen, Panoptic.kind)
    checkpoint.recipe["panoptic"] |= {"unseen": int((~in_view).sum()), "pseudo": labels.source}
    return checkpoint, []


def _fit(
    request: FinetuneRequest,
    monitor: JobMonitor,
    frames: list[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    seen: frozenset[int],
    kind: str,
) -> Checkpoint:
    monitor.start(100)

    def on_progress(progress: FitProgress) -> None:
        note = f"step {progress.step}"
        if math.isfinite(progress.held_out_loss):
            note += f" held-out loss {progress.held_out_loss:.3f}"
        if not math.isnan(progress.held_out_accuracy):
            note += f" accuracy {progress.held_out_accuracy * 100:.1f} %"
        monitor.set(int(progress.fraction * 100), note)

    checkpoint = finetune(frames, label_set, start, request.config, on_progress, lambda: monitor.stopped_by, seen, kind)
    learned = "grid_steps" if kind == Panoptic.kind else "steps"  # boxes need no more than geometry
    if monitor.stopped_by and not checkpoint.recipe[learned]:
        raise KeyboardInterrupt
    checkpoint.recipe["source"] = request.log.name
    return checkpoint


class ComputedFrame(NamedTuple):
    """What was computed of a frame, at the size that depth is computed at: depth (h, w), 0 = none, its one-sigma spread
    (h, w), and the pose (4, 4) that goes with it."""

    depth_m: Float32
    depth_sigma_m: Float32
    T_world_camera: Float64

    def on(self, frame: PosedFrame) -> PosedFrame:
        """The frame with this depth, enlarged to its size, at this pose."""
        size = frame.intrinsics.width, frame.intrinsics.height
        depth, sigma = (
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
            for image in (self.depth_m, self.depth_sigma_m)
        )
        return replace(frame, depth_m=depth, depth_sigma_m=sigma, T_world_camera=self.T_world_camera)


def _compute_depths(log: Log, config: DepthConfig, monitor: JobMonitor) -> Mapping[FrameKey, ComputedFrame]:
    """What ``config`` asks to compute; nothing of a log whose first frame has depth, unless it says "computed"."""
    if config.source not in ("auto", "computed") or (config.source == "auto" and next(iter(log)).depth_m is not None):
        return {}
    monitor.start(len(log))
    return compute_depths(log, config, lambda done: _go_on(monitor, done, "computing depth from pictures"))


def compute_depths(
    frames: Iterable[PosedFrame], config: DepthConfig, on_frame: Callable[[int], None]
) -> dict[FrameKey, ComputedFrame]:
    """What was computed of each frame without a sensor's depth, by its camera and stamp.

    Frames whose pictures nothing can be computed from (dark, blurred, standing still) are left out, with a line in the
    log. No map gives hints, so depth is a little less exact than in ``map``. ``config.source`` is "auto" or
    "computed"; ``on_frame`` is called with the number of frames that are read."""

    def no_hint(_: PosedFrame, intrinsics: CameraIntrinsics) -> tuple[Float32, np.ndarray]:
        empty = np.zeros((intrinsics.height, intrinsics.width), np.float32)
        return empty, empty > 0

    computer, found = FrameDepth(config, no_hint), dict[FrameKey, ComputedFrame]()

    def keep(ready: Iterable[PosedFrame]) -> None:
        for frame in ready:
            small = working_intrinsics(frame.intrinsics, config.from_motion.width)
            if frame.depth_m is not None and (sigma_m := resize_spread(frame, small)) is not None:
                computed = ComputedFrame(resize_depth(frame, small), sigma_m, frame.T_world_camera)
                found[frame.camera_id, frame.stamp_ns] = computed

    for number, frame in enumerate(frames):
        try:
            keep(computer.push(frame))
        except FrameError as error:
            _log.warning("no_depth_computed", seq=frame.seq, reason=str(error))
        on_frame(number + 1)
    keep(computer.finish())
    return found


def _go_on(monitor: JobMonitor, done: int, note: str) -> None:
    monitor.set(done, note)
    if monitor.stopped_by:
        raise KeyboardInterrupt


@dataclass(frozen=True, slots=True)
class FrameSource:
    """The frames of a log as a request has them: labels of the folder before the log's, with the requested depth.

    All that read many raise KeyboardInterrupt: a stop request came.
    """

    log: Log
    folder: LabelFolder | None
    request: FinetuneRequest
    monitor: JobMonitor
    computed: Mapping[FrameKey, ComputedFrame]

    def choose_labelled(self, label_set: LabelSet, least: int = 2) -> dict[int, PosedFrame]:
        """The labelled frames that show most of what the log shows, by number in it; without a number of them, all.

        Of a log whose depth is computed, frames that it could be computed for. Raises LogError: fewer usable labelled
        frames than requested, or than ``least``.
        """
        sizes: set[tuple[int, int]] = set()

        def read(number: int) -> Candidate | None:
            frame = self._labelled(number)
            if frame.label is None or (self.computed and (frame.camera_id, frame.stamp_ns) not in self.computed):
                return None
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
            label_set.to_channels(frame.label, f"frame seq={frame.seq}")
            size = frame.intrinsics.width, frame.intrinsics.height
            if sizes and size not in sizes:  # one finetuning takes views of one size
                raise FrameError(f"{size[0]}x{size[1]} pixels, but those before have another size")
            sizes.add(size)
            candidate = candidate_from_frame(self._with_depth(frame))
            return None if self.computed and len(candidate.cells) == 0 else candidate  # the camera had not moved yet

        readable = range(len(self.log)) if self.folder is None else self.folder.numbers()
        candidates = dict(self._each(readable, read, "choosing keyframes"))
        count, numbers = self.request.keyframes, list(candidates)
        if len(numbers) < (count or least):
            more = f"--keyframes {count} is more than that" if count else "finetuning needs two"
            where = self.request.log if self.folder is None else self.folder.path
            raise LogError(f"{where}: {len(numbers)} of the {len(self.log)} frames have usable labels; {more}")
        if count:
            chosen = choose_keyframes(list(candidates.values()), count, self.request.config.seed)
            numbers = [numbers[i] for i in chosen]
        return {number: self._with_depth(self._labelled(number)) for number in numbers}

    def unlabelled(self, labelled: list[PosedFrame]) -> list[PosedFrame]:
        """The other frames of the log at working width, without labels: at most ``MAX_SCENE_FRAMES``, evenly spread."""
        known = {(f.camera_id, f.stamp_ns) for f in labelled}

        def read(number: int) -> PosedFrame | None:
            frame = self.log.frame(number)
            if (frame.camera_id, frame.stamp_ns) in known:
                return None
            return anchor_from_frame(replace(self._with_depth(frame), label=None), self.request.config.width)

        numbers = _evenly(range(len(self.log)), MAX_SCENE_FRAMES)
        return [frame for _, frame in self._each(numbers, read, "reading frames")]

    def pseudo_labelled(self, labels: "PseudoLabels") -> list[PosedFrame]:
        """Frames at working width with their pseudo labels, at most ``MAX_SCENE_FRAMES``; see ``choose_frames``.

        A frame whose label image is missing or cannot be used gives its colours alone; these are counted.
        Raises LogError: no frame has a pseudo label.
        """
        reasons: list[str] = []

        def read(number: int) -> PosedFrame:
            frame = self._with_depth(self.log.frame(number))
            try:
                labelled = labels.of(frame, number)
                if labelled.label is not None:
                    labels.label_set.to_channels(labelled.label, f"frame seq={frame.seq}")
            except (LogError, LabelError, FrameError) as error:
                reasons.append(str(error))
                labelled = replace(frame, label=None)
            small = anchor_from_frame(labelled, self.request.config.width)
            return replace(small, label_is_pseudo=labelled.label_is_pseudo and labelled.label is not None)

        numbers = choose_frames(len(self.log), MAX_SCENE_FRAMES, labels.numbers)
        frames = [frame for _, frame in self._each(numbers, read, "reading frames and pseudo labels")]
        if not any(f.label is not None for f in frames):
            raise LogError(f"{self.log.path}: no frame has a pseudo label ({reasons[0] if reasons else labels.source})")
        if reasons:
            _log.warning("frames_without_pseudo_label", count=len(reasons), reason=reasons[0])
        return [labels.of_map(frame) for frame in frames]

    def _each(
        self, numbers: Sequence[int], read: Callable[[int], ItemT | None], note: str
    ) -> Iterator[tuple[int, ItemT]]:
        """What is read of frames; those that cannot be used are left out, with a warning that counts them."""
        reasons: list[str] = []
        self.monitor.start(len(numbers))
        for done, number in enumerate(numbers, 1):
            _go_on(self.monitor, done, note)
            try:
                found = read(number)
            except (LogError, FrameError, LabelError) as error:
                reasons.append(f"frame {number}: {error}")
                continue
            if found is not None:
                yield number, found
        if reasons:
            _log.warning("frames_left_out", count=len(reasons), reason=reasons[0])

    def _labelled(self, number: int) -> PosedFrame:
        frame = self.log.frame(number)
        return frame if self.folder is None else self.folder.labelled(frame, number)

    def _with_depth(self, frame: PosedFrame) -> PosedFrame:
        """The frame with the depth that it is trained with."""
        wanted = ("auto", "computed") if frame.depth_sigma_m is not None else ("auto", "sensor")
        if frame.depth_m is not None and self.request.depth.source not in wanted:
            frame = replace(frame, depth_m=None, depth_sigma_m=None)
        found = self.computed.get((frame.camera_id, frame.stamp_ns))
        return frame if frame.depth_m is not None or found is None else found.on(frame)


@dataclass(frozen=True, slots=True)
class PseudoLabels:
    """Where label images come from: a folder, the map that weights make of the frames, or else the frames."""

    label_set: LabelSet  # of them
    source: str  # for people
    numbers: frozenset[int] | None = None  # frames that have one; None = all
    folder: LabelFolder | None = None
    mapper: Mapper | None = None

    @property
    def train_stamps_ns(self) -> frozenset[int]:
        """Frames whose true labels those who made them have learned from."""
        return frozenset() if self.mapper is None else self.mapper.weights.train_stamps_ns

    def of(self, frame: PosedFrame, number: int) -> PosedFrame:
        """A frame, by its number in the log, with its pseudo label, or without a label."""
        if self.folder is not None:
            return replace(self.folder.labelled(frame, number), label_is_pseudo=True)
        if self.mapper is None:
            return frame
        label = self.mapper.step(replace(frame, label=None, label_is_pseudo=False)).label
        return replace(frame, label=label, label_is_pseudo=True)

    def of_map(self, frame: PosedFrame) -> PosedFrame:
        """A frame, once ``of`` has seen all, with the labels of the map, else its own: many views err less."""
        if self.mapper is None or frame.label is None:
            return frame
        seen = self.mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
        return replace(frame, label=np.where(seen == self.mapper.label_set.ignore_id, frame.label, seen))


def open_pseudo_labels(log: Log, pseudo: str | None) -> PseudoLabels:
    """The pseudo labels of a log.
    ``pseudo``: folder of label images, or weights; None = the log's own label images, else the shipped weights. Raises
    LabelError, LogError, WeightsError: they cannot be read."""
    if pseudo is not None and Path(pseudo).is_dir():
        folder = open_label_folder(Path(pseudo), log)
        return PseudoLabels(folder.label_set, f"the folder {pseudo}", frozenset(folder.numbers()), folder)
    if pseudo is None and log.info.label_set is not None:
        numbers = frozenset(n for n, (envelope, _) in enumerate(log.frame_parts()) if envelope.has_label)
        if numbers:
            return PseudoLabels(log.info.label_set, "the log's own label images", numbers)
    mapper = Mapper.load(pseudo, MapperConfig(voxel_map=VoxelMapConfig(unknown_below=0.0)))  # teach every class
    mapper.voxel_map.note_scale(log.info.scale_known)
    source = f"the map that {mapper.weights_path.name} makes of the frames"
    return PseudoLabels(mapper.label_set, source, mapper=mapper)


def choose_frames(total: int, count: int, labelled: frozenset[int] | None) -> list[int]:
    """Numbers of ``count`` of ``total`` frames at most, ascending: labelled ones first, evenly spread."""
    first = range(total) if labelled is None else sorted(labelled)
    chosen = _evenly(first, count)
    rest = sorted(set(range(total)) - set(first))
    return sorted(chosen + _evenly(rest, count - len(chosen)))


def _evenly(numbers: Sequence[int], count: int) -> list[int]:
    count = min(count, len(numbers))
    return [numbers[round(i * (len(numbers) - 1) / max(count - 1, 1))] for i in range(count)]
