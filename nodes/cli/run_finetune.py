"""Finetuning on a log: choose keyframes, train, write the weights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import structlog

from semantic_mapper.config import DepthConfig
from semantic_mapper.errors import ConfigError, FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import (
    Checkpoint,
    anchor_from_frame,
    default_checkpoint_path,
    load_checkpoint,
    save_checkpoint,
)
from semantic_mapper.fields.irt import IRT
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.panoptic import Panoptic
from semantic_mapper.fields.primitive_rays import MAX_INTERVALS
from semantic_mapper.fields.sray import SRay
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import ROOMS, LabelSet
from semantic_mapper.nodes.cli.console import FrameProgress
from semantic_mapper.nodes.cli.outputs import prepare_file
from semantic_mapper.nodes.cli.pseudo_labels import boxed_field, match_boxes, open_pseudo_labels, read_pseudo_labelled
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.autolabel_note import read_note
from semantic_mapper.replay.boxes import BoxFile, load_boxes, with_times
from semantic_mapper.replay.label_folder import LabelFolder, open_label_folder
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.replay.log_depth import ComputedFrame, compute_depths
from semantic_mapper.training.finetune import FinetuneConfig, FinetuneProgress
from semantic_mapper.training.fitters import FITTERS, fitter_of
from semantic_mapper.training.frame_rays import usable_frames
from semantic_mapper.training.select import candidate_from_frame, choose_keyframes
from semantic_mapper.training.strokes import grow_strokes, labelled_fraction
from semantic_mapper.types import PosedFrame

LEAST_KEYFRAMES = 2
MAX_SCENE_FRAMES = 300  # that a field of one scene is fitted to
_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class FinetuneRequest:
    """What the verb was requested; ``weights`` None = those in the package, ``from_scratch`` = random ones.

    ``depth`` says where the frames' depth comes from. ``kind`` names a kind of field that is fitted to one scene, from
    nothing; None = that of the weights. ``labels`` is a folder of label images in place of the log's. ``keyframes`` is
    0 for a kind that learns no classes, and for all frames that the folder has labels of. ``frames`` (numbers in the
    log) names the labelled frames instead. ``unlabelled``: how many others a kind of one scene uses at most, 0 = all,
    None = 300. ``boxes``, ``pseudo`` (folder or weights) and ``uncovered`` are of the kind "panoptic".
    ``strokes``: label images are strokes, and grow.
    """

    log: Path
    keyframes: int
    out: Path
    config: FinetuneConfig
    weights: Path | None
    from_scratch: bool
    depth: DepthConfig
    kind: str | None = None
    labels: Path | None = None
    frames: Sequence[int] = ()
    unlabelled: int | None = None
    boxes: Path | None = None
    pseudo: str | None = None
    uncovered: str = "stuff"
    strokes: bool = False


def finetune_log(request: FinetuneRequest, stop: StopRequest, bar: FrameProgress) -> tuple[Checkpoint, list[int]]:
    """Finetune on keyframes of a log and write the weights: after a stop request, the best so far.

    Returns:
        The weights, and the numbers in the log of the frames they were fitted to, as ``frames`` takes them.

    Raises:
        LogError, LabelError, FrameError, WeightsError, ConfigError: with what is wrong and the mend.
    """
    if request.out.resolve() == request.log.resolve():
        raise ConfigError(f"{request.out}: is the log itself; choose another name for the weights")
    if request.out.is_file() and request.out.suffix != ".safetensors":
        raise ConfigError(f"{request.out}: is there, and no weights file; give --out a name that ends in .safetensors")
    prepare_file(request.out)
    if request.boxes is not None:
        return _finetune_boxes(request, load_boxes(request.boxes), stop, bar), []
    # First, so that a wrong path does not cost the reading of a log.
    nothing = request.from_scratch or request.kind is not None
    start = None if nothing else load_checkpoint(request.weights or default_checkpoint_path())
    kind = request.kind or (SRay.kind if start is None else start.model.kind)
    _check_options(request, kind)
    with open_log(request.log) as log:
        folder = None if request.labels is None else open_label_folder(request.labels, log)
        label_set = log.info.label_set if folder is None else folder.label_set
        if label_set is None and (request.keyframes or request.frames):
            raise LabelError(
                f"{request.log}: has no label images; finetuning needs labelled keyframes. Make some with "
                "`semantic-mapper label LOG --serve`, and give their folder with --labels"
            )
        label_set = label_set or ROOMS
        computed = _compute_depths(log, request.depth, stop, bar)
        by_number: dict[int, PosedFrame] = {}
        if request.frames:
            by_number = _named(log, request, computed, folder)
        elif request.keyframes or folder is not None:  # a folder without a number: all that it has
            by_number = choose_labelled(log, label_set, request, computed, stop, bar, folder)
        frames, chosen = list(by_number.values()), list(by_number)
        pseudo = sum(f.label_is_pseudo for f in frames)
        grown: dict[str, float] = {}
        if request.strokes:
            grown["painted"] = labelled_fraction(frames, label_set)
            frames = [grow_strokes(frame, label_set) for frame in frames]
            grown["grown"] = labelled_fraction(frames, label_set)
        if kind in FITTERS:
            frames += read_unlabelled(log, frames, request, computed, stop, bar)
        note = read_note(log.attachments())
    seen = frozenset[int]() if start is None else start.train_stamps_ns
    if pseudo and note is not None:
        seen |= frozenset(note.train_stamps_ns)  # who learns from a teacher has learned from its keyframes
    checkpoint = _fit(kind, frames, label_set, None if start is None else start.model, seen, request, stop, bar)
    if pseudo:
        checkpoint.recipe["pseudo_labels"] = {"keyframes": pseudo, "of": "" if note is None else note.weights}
    if grown:
        checkpoint.recipe["strokes"] = grown
    save_checkpoint(checkpoint, request.out)
    return checkpoint, chosen


def _fit(
    kind: str,
    frames: list[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    seen: frozenset[int],
    request: FinetuneRequest,
    stop: StopRequest,
    bar: FrameProgress,
) -> Checkpoint:
    """Fit, with progress.

    Raises:
        KeyboardInterrupt: a stop request came before anything was learned: no reason to touch the file.
    """
    bar.start(100)

    def on_progress(progress: FinetuneProgress) -> None:
        note = f"step {progress.step}"
        if math.isfinite(progress.held_out_loss):
            note += f" held-out loss {progress.held_out_loss:.3f}"
        if not math.isnan(progress.held_out_accuracy):
            note += f" accuracy {progress.held_out_accuracy * 100:.1f} %"
        bar.set(int(progress.fraction * 100), note)

    checkpoint = fitter_of(kind)(frames, label_set, start, request.config, on_progress, lambda: stop, seen)
    learned = "grid_steps" if kind == Panoptic.kind else "steps"  # boxes need no more than geometry
    if stop and not checkpoint.recipe[learned]:
        raise KeyboardInterrupt
    checkpoint.recipe["source"] = request.log.name
    return checkpoint


def _finetune_boxes(request: FinetuneRequest, boxes: BoxFile, stop: StopRequest, bar: FrameProgress) -> Checkpoint:
    """Fit a field of kind "panoptic" and write the weights.

    Raises:
        LogError, LabelError, FrameError, WeightsError, ConfigError: with what is wrong and the mend.
    """
    assert request.boxes is not None
    with open_log(request.log) as log:
        labels = open_pseudo_labels(log, request.pseudo)
        boxes, label_set = match_boxes(boxes, request.boxes, labels)
        boxes, dropped = with_times(boxes, request.boxes, log)
        computed = _compute_depths(log, request.depth, stop, bar)
        frames = read_pseudo_labelled(
            log,
            labels,
            lambda frame: _as_given(frame, computed, request.depth),
            MAX_SCENE_FRAMES if request.unlabelled is None else request.unlabelled,
            request.config.width,
            stop,
            bar,
        )
        note = read_note(log.attachments())
    start, unseen = boxed_field(boxes, usable_frames(frames), label_set, request.uncovered)
    seen = labels.train_stamps_ns
    if note is not None and any(f.label_is_pseudo for f in frames):
        seen |= frozenset(note.train_stamps_ns)
    checkpoint = _fit(Panoptic.kind, frames, label_set, start, seen, request, stop, bar)
    figures = checkpoint.recipe["panoptic"]
    figures |= {"left_out": boxes.left_out, "unseen": unseen, "pseudo": labels.source}
    figures["lost"] += len(dropped)
    save_checkpoint(checkpoint, request.out)
    return checkpoint


def finetune_lines(checkpoint: Checkpoint, chosen: Sequence[int], request: FinetuneRequest) -> list[str]:
    """What was learned, for a reader."""
    recipe, out, log = checkpoint.recipe, request.out, request.log.name
    lines = [f"{out}: finetuned on frames {', '.join(map(str, chosen))} of {log}"] if chosen else []
    if "psnr" in recipe:
        psnr = "no held-out views rendered" if recipe["psnr"] is None else f"held-out views {recipe['psnr']:.1f} dB"
        steps = recipe.get("grid_steps", recipe["steps"])
        lines.append(f"{out}: grid of {log}, {steps} steps in {recipe['seconds']} s, {psnr}")
    if "held_out_loss" in recipe:
        lines.append(
            f"  {recipe['steps']} steps in {recipe['seconds']} s, best at step {recipe['best_step']}: held-out loss "
            f"{recipe['held_out_loss']:.3f}, accuracy {recipe['held_out_accuracy'] * 100:.1f} %"
        )
    if pseudo := recipe.get("pseudo_labels"):
        by = f" that {pseudo['of']} has rendered" if pseudo["of"] else ""
        lines.append(
            f"  {pseudo['keyframes']} of the {len(chosen)} keyframes have pseudo labels{by}: the figures above say how "
            "well these are learned, not how right they are"
        )
    if grown := recipe.get("strokes"):
        lines.append(
            f"  strokes of {_per_cent(grown['painted'])} of the keyframes' pixels have grown to "
            f"{_per_cent(grown['grown'])}"
        )
    if own := recipe.get("own_view"):
        lines.append(
            f"  a frame's own image counts {own['factor']:g} times among the views, "
            f"{own['factor_without_depth']:g} times where there is no depth"
        )
    if boxed := recipe.get("panoptic"):
        lines.append(
            f"  {boxed['seen']} of {boxed['boxes']} boxes seen; pixels that meet one {_per_cent(boxed['covered'])}, "
            f"with a surface in boxes of several classes {_per_cent(boxed['ambiguous'])}; pseudo labels "
            f"({boxed['pseudo']}) of {boxed['labelled_frames']} of {boxed['frames']} frames, matched "
            f"{_per_cent(boxed['matched'])}"
        )
        if checkpoint.model.config.classes == "fixed":
            lines.append(
                "  stopped before classes were learned: they are those of the boxes alone; what is in none of them "
                "(wall or floor) is not told apart"
            )
        if boxed["crowded"]:
            lines.append(
                f"  {_per_cent(boxed['crowded'])} of the pixels meet more than {MAX_INTERVALS} boxes: of these the "
                "nearest count"
            )
        if boxed["moving"]:
            lines.append(f"  {boxed['moving']} boxes that move, with grids of their own")
        if left_out := [text for count, text in _left_out(boxed) if count]:
            lines.append(f"  boxes left out: {'; '.join(left_out)}")
    if checkpoint.model.holds_scene:
        lines.append(f"  {out.stat().st_size / 1e6:.1f} MB that show the scene: as private as the recording")
    return lines


def _left_out(boxed: Mapping[str, Any]) -> list[tuple[int, str]]:
    """How many boxes were left out, for which reason."""
    reasons = {
        "unseen": "that no frame sees",
        "lost": "that move, which no frame shows at their times",
        "left_out": "of no class, or of one that the labels lack",
    }
    return [(boxed[name], f"{boxed[name]} {reason}") for name, reason in reasons.items()]


def _per_cent(fraction: float) -> str:
    return f"{100 * fraction:.1f} %"


def _check_options(request: FinetuneRequest, kind: str) -> None:
    """Refuse options that go with other weights.

    Raises:
        ConfigError: which.
    """
    if request.unlabelled is not None and kind not in FITTERS:
        raise ConfigError(f"--unlabelled: weights of kind '{kind}' learn from labelled frames alone; leave it out")
    if request.config.irt.variant is not None and kind != IRT.kind:
        raise ConfigError(f"--variant (irt.variant): goes with weights of kind 'irt', not with '{kind}'; leave it out")


def _named(
    log: Log,
    request: FinetuneRequest,
    computed: Mapping[tuple[str, int], ComputedFrame],
    folder: LabelFolder | None,
) -> dict[int, PosedFrame]:
    """The labelled frames that the request names, by number in the log, with the depth that it asks for.

    Raises:
        LogError: the log has no such frame, or it has no label image.
    """
    frames: dict[int, PosedFrame] = {}
    for number in sorted(set(request.frames)):
        if number >= len(log):
            raise LogError(f"{request.log}: has no frame {number}; it has {len(log)}")
        frame = log.frame(number) if folder is None else folder.labelled(log.frame(number), number)
        if frame.label is None:
            raise LogError(f"{request.log}: frame {number} has no label image; give one in a folder with --labels")
        frames[number] = _as_given(frame, computed, request.depth)
    return frames


def _compute_depths(
    log: Log, config: DepthConfig, stop: StopRequest, bar: FrameProgress
) -> Mapping[tuple[str, int], ComputedFrame]:
    """What ``config`` asks to compute; nothing of a log whose first frame has depth, unless it says "computed".

    Raises:
        KeyboardInterrupt: a stop request came.
    """
    if config.source not in ("auto", "computed"):
        return {}
    if config.source == "auto" and next(iter(log)).depth_m is not None:
        return {}
    bar.start(len(log))

    def on_frame(done: int) -> None:
        bar.set(done, "computing depth from pictures")
        if stop:
            raise KeyboardInterrupt

    return compute_depths(log, config, on_frame)


def _as_given(frame: PosedFrame, computed: Mapping[tuple[str, int], ComputedFrame], config: DepthConfig) -> PosedFrame:
    """The frame with the depth that it is trained with."""
    if frame.depth_sigma_m is not None:  # the log's depth is no sensor's
        if config.source in ("off", "sensor"):
            frame = replace(frame, depth_m=None, depth_sigma_m=None)
    elif config.source in ("off", "computed") and frame.depth_m is not None:
        frame = replace(frame, depth_m=None)
    found = computed.get((frame.camera_id, frame.stamp_ns))
    return frame if frame.depth_m is not None or found is None else found.on(frame)


def choose_labelled(
    log: Log,
    label_set: LabelSet,
    request: FinetuneRequest,
    computed: Mapping[tuple[str, int], ComputedFrame],
    stop: StopRequest,
    bar: FrameProgress,
    folder: LabelFolder | None = None,
) -> dict[int, PosedFrame]:
    """The labelled frames that show most of what the log shows, by number in it, with the depth that is asked for.

    Of a log whose depth is computed, frames that it could be computed for. Labels of a ``folder`` go before those of
    the log; without a number of keyframes, all of them are taken.

    Raises:
        LogError: fewer usable labelled frames than requested.
        KeyboardInterrupt: a stop request came.
    """
    candidates, numbers = [], []
    size: tuple[int, int] | None = None
    looked_at = range(len(log)) if folder is None else folder.numbers()
    bar.start(len(looked_at))
    for done, number in enumerate(looked_at):
        bar.set(done + 1, "choosing keyframes")
        if stop:
            raise KeyboardInterrupt
        try:
            frame = log.frame(number) if folder is None else folder.labelled(log.frame(number), number)
            if frame.label is None or (computed and (frame.camera_id, frame.stamp_ns) not in computed):
                continue
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
            label_set.to_channels(frame.label, f"frame seq={frame.seq}")
            size = size or (frame.intrinsics.width, frame.intrinsics.height)
            _check_size(frame, size)
        except (LogError, FrameError, LabelError) as error:
            _log.warning("frame_left_out", frame=number, reason=str(error))
            continue
        candidate = candidate_from_frame(_as_given(frame, computed, request.depth))
        if computed and len(candidate.cells) == 0:  # the camera had not moved yet
            continue
        candidates.append(candidate)
        numbers.append(number)
    if len(candidates) < (request.keyframes or LEAST_KEYFRAMES):
        more = f"--keyframes {request.keyframes} is more than that" if request.keyframes else "finetuning needs two"
        where = request.log if folder is None else folder.path
        raise LogError(f"{where}: {len(candidates)} of the {len(log)} frames have usable labels; {more}")
    chosen = range(len(candidates))
    if request.keyframes:
        chosen = choose_keyframes(candidates, request.keyframes, request.config.seed)
    frames: dict[int, PosedFrame] = {}
    for number in (numbers[i] for i in chosen):
        frame = log.frame(number) if folder is None else folder.labelled(log.frame(number), number)
        frames[number] = _as_given(frame, computed, request.depth)
    return frames


def read_unlabelled(
    log: Log,
    labelled: list[PosedFrame],
    request: FinetuneRequest,
    computed: Mapping[tuple[str, int], ComputedFrame],
    stop: StopRequest,
    bar: FrameProgress,
) -> list[PosedFrame]:
    """The other frames of the log at working width, without labels: as many as requested, evenly spread.

    Frames that cannot be read are left out and counted.

    Raises:
        KeyboardInterrupt: a stop request came.
    """
    known = {(f.camera_id, f.stamp_ns) for f in labelled}
    most = MAX_SCENE_FRAMES if request.unlabelled is None else request.unlabelled
    count = min(most or len(log), len(log))
    frames: list[PosedFrame] = []
    damaged = 0
    bar.start(len(log))
    for number in sorted({round(i * (len(log) - 1) / max(count - 1, 1)) for i in range(count)}):
        bar.set(number + 1, "reading frames")
        if stop:
            raise KeyboardInterrupt
        try:
            frame = log.frame(number)
        except (LogError, FrameError):
            damaged += 1
            continue
        if (frame.camera_id, frame.stamp_ns) not in known:
            given = replace(_as_given(frame, computed, request.depth), label=None)
            frames.append(anchor_from_frame(given, request.config.width))
    if damaged:
        _log.warning("frames_left_out", count=damaged, reason="they cannot be read; `semantic-mapper recover` may help")
    return frames


def _check_size(frame: PosedFrame, size: tuple[int, int]) -> None:
    """One finetuning takes views of one size.

    Raises:
        FrameError: another size.
    """
    k = frame.intrinsics
    if (k.width, k.height) != size:
        raise FrameError(f"frame seq={frame.seq}: {k.width}x{k.height}, but the first one is {size[0]}x{size[1]}")
