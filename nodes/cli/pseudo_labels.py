"""Pseudo labels for ``finetune --kind panoptic``: of a folder, of weights, or the log's own images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import structlog

from semantic_mapper.config import PanopticConfig
from semantic_mapper.errors import ConfigError, FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import (
    anchor_from_frame,
    default_checkpoint_path,
    load_checkpoint,
    shipped_checkpoint,
)
from semantic_mapper.fields.panoptic import Panoptic, box_config
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapper import Mapper
from semantic_mapper.nodes.cli.console import FrameProgress
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.boxes import BoxFile, with_classes
from semantic_mapper.replay.label_folder import LabelFolder, open_label_folder
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.training.boxes_in_view import boxes_in_view
from semantic_mapper.types import PosedFrame

OWN = "the log's own label images"
_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PseudoLabels:
    """Where label images come from.

    Args:
        label_set: Of them.
        of: The frame, by number in the log, with its pseudo label, or without a label.
        source: For people.
        numbers: Frames that have one; None = all.
        train_stamps_ns: Frames whose true labels those who made them have learned from.
        once_all_are_seen: A frame and its label, once ``of`` has seen all of them.
    """

    label_set: LabelSet
    of: Callable[[PosedFrame, int], PosedFrame]
    source: str
    numbers: frozenset[int] | None = None
    train_stamps_ns: frozenset[int] = frozenset()
    once_all_are_seen: Callable[[PosedFrame], PosedFrame] = lambda frame: frame


def open_pseudo_labels(log: Log, pseudo: str | None) -> PseudoLabels:
    """The pseudo labels of a log.

    Args:
        log: The log.
        pseudo: Folder of label images, or weights; None = the log's own label images, else the shipped weights.

    Raises:
        ConfigError: ``pseudo`` names both a folder and weights in the package.
        LabelError, LogError, WeightsError: they cannot be read.
    """
    if pseudo is not None and Path(pseudo).is_dir():
        if "/" not in pseudo and shipped_checkpoint(Path(pseudo)) is not None:
            raise ConfigError(
                f"--pseudo {pseudo}: is a folder here, and weights in the package have this name. Give ./{pseudo} for "
                "the label images in the folder; for the weights run the command elsewhere, or rename the folder"
            )
        folder = open_label_folder(Path(pseudo), log)
        source, numbers = f"the folder {pseudo}", frozenset(folder.numbers())
        return PseudoLabels(folder.label_set, lambda f, n: _of_folder(folder, f, n), source, numbers)
    if pseudo is None and log.info.label_set is not None:
        numbers = frozenset(n for n, (envelope, _) in enumerate(log.frame_parts()) if envelope.has_label)
        if numbers:
            return PseudoLabels(log.info.label_set, lambda frame, _: frame, OWN, numbers)
    mapper = Mapper.load(pseudo)
    mapper.voxel_map.note_scale(log.info.scale_known)
    source = f"the map that {mapper.weights_path.name} makes of the frames"
    stamps = mapper.checkpoint.train_stamps_ns
    return PseudoLabels(
        mapper.label_set, lambda f, _: _rendered(mapper, f), source, None, stamps, lambda f: _cast_back(mapper, f)
    )


def read_pseudo_labelled(
    log: Log,
    labels: PseudoLabels,
    as_given: Callable[[PosedFrame], PosedFrame],
    count: int,
    width: int,
    stop: StopRequest,
    bar: FrameProgress,
) -> list[PosedFrame]:
    """Frames of a log at working width with their pseudo labels: ``count`` at most (0 = all), see ``choose_frames``.

    A frame whose label image is missing or cannot be used gives its colours alone; these are counted.

    Raises:
        LogError: no frame has a pseudo label.
        KeyboardInterrupt: a stop request came.
    """
    frames: list[PosedFrame] = []
    reasons: list[str] = []
    bar.start(len(log))
    for number in choose_frames(len(log), count or len(log), labels.numbers):
        bar.set(number + 1, "reading frames and pseudo labels")
        if stop:
            raise KeyboardInterrupt
        try:
            frame = as_given(log.frame(number))
        except (LogError, FrameError) as error:
            reasons.append(str(error))
            continue
        try:
            labelled = labels.of(frame, number)
            if labelled.label is not None:
                labels.label_set.to_channels(labelled.label, f"frame seq={frame.seq}")
        except (LogError, LabelError, FrameError) as error:
            reasons.append(str(error))
            labelled = replace(frame, label=None)
        small = anchor_from_frame(labelled, width)
        frames.append(replace(small, label_is_pseudo=labelled.label_is_pseudo and labelled.label is not None))
    if not any(f.label is not None for f in frames):
        raise LogError(f"{log.path}: no frame has a pseudo label ({reasons[0] if reasons else labels.source})")
    if reasons:
        _log.warning("frames_without_pseudo_label", count=len(reasons), reason=reasons[0])
    return [labels.once_all_are_seen(frame) for frame in frames]


def choose_frames(total: int, count: int, labelled: frozenset[int] | None) -> list[int]:
    """Numbers of ``count`` of ``total`` frames at most, ascending: labelled ones first, evenly spread."""
    first = range(total) if labelled is None else sorted(labelled)
    chosen = _evenly(first, count)
    rest = sorted(set(range(total)) - set(first))
    return sorted(chosen + _evenly(rest, count - len(chosen)))


def match_boxes(boxes: BoxFile, path: Path, labels: PseudoLabels) -> tuple[BoxFile, LabelSet]:
    """Boxes that can go with pseudo labels, and the label set of a field of them; see ``with_classes``.

    Raises:
        ConfigError: a class that these lack, with where they come from and what may be done; or no box.
    """
    needed = {p.class_name for p in boxes.primitives}.union(*([name, *others] for name, others in boxes.merge.items()))
    try:
        boxes, label_set = with_classes(boxes, labels.label_set, path)
    except ConfigError as error:
        end = "" if str(error).endswith("?") else "."
        raise ConfigError(f"{error}{end} {_where_classes_come_from(labels, needed)}") from error
    if not boxes.primitives:
        raise ConfigError(f"{path}: holds no box; draw some, or take `query MAP instances`")
    return boxes, label_set


def boxed_field(
    boxes: BoxFile, frames: Sequence[PosedFrame], label_set: LabelSet, uncovered: str
) -> tuple[Panoptic, int]:
    """An empty field with the boxes that frames may see, and how many they cannot.

    Raises:
        ConfigError: they can see none.
    """
    seen = boxes_in_view(boxes.primitives, frames)
    config = PanopticConfig(
        boxes=tuple(box_config(p) for p, there in zip(boxes.primitives, seen, strict=True) if there),
        merge=dict(boxes.merge),
        uncovered="empty" if uncovered == "empty" else "stuff",
    )
    return Panoptic(config, label_set), int((~seen).sum())


def _where_classes_come_from(labels: PseudoLabels, needed: set[str]) -> str:
    said = f"Pseudo labels are {labels.source}"
    path = default_checkpoint_path()
    if labels.source == OWN and needed <= set(load_checkpoint(path).label_set.names):
        return f"{said}; weights '{path.stem}' have all classes of the boxes: --pseudo {path.stem} takes their labels"
    return (
        f"{said}: correct the classes of the boxes, say in `merge` of the file which class of the "
        "labels stands for it, or give other labels (--pseudo)"
    )


def _evenly(numbers: Sequence[int], count: int) -> list[int]:
    count = min(count, len(numbers))
    return [numbers[round(i * (len(numbers) - 1) / max(count - 1, 1))] for i in range(count)]


def _of_folder(folder: LabelFolder, frame: PosedFrame, number: int) -> PosedFrame:
    return replace(folder.labelled(frame, number), label_is_pseudo=True)


def _rendered(mapper: Mapper, frame: PosedFrame) -> PosedFrame:
    label = mapper.step(replace(frame, label=None, label_is_pseudo=False)).label
    return replace(frame, label=label, label_is_pseudo=True)


def _cast_back(mapper: Mapper, frame: PosedFrame) -> PosedFrame:
    """A frame with the labels of the map, and its own where the map has none: many views err less than one."""
    if frame.label is None:
        return frame
    seen = mapper.voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label
    return replace(frame, label=np.where(seen == mapper.label_set.ignore_id, frame.label, seen))
