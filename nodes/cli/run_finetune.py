"""Finetuning on a log: choose keyframes, train, write the weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import structlog

from semantic_mapper.errors import FrameError, LabelError, LogError
from semantic_mapper.fields.checkpoint import Checkpoint, default_checkpoint_path, load_checkpoint, save_checkpoint
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.cli.console import FrameProgress
from semantic_mapper.nodes.cli.outputs import prepare_file
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.sequence import Log, open_log
from semantic_mapper.training.finetune import FinetuneConfig, FinetuneProgress, finetune
from semantic_mapper.training.select import candidate_from_frame, choose_keyframes
from semantic_mapper.types import PosedFrame

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class FinetuneRequest:
    """What the verb was requested; ``weights`` None = those in the package, ``from_scratch`` = random ones."""

    log: Path
    keyframes: int
    out: Path
    config: FinetuneConfig
    weights: Path | None
    from_scratch: bool


def finetune_log(request: FinetuneRequest, stop: StopRequest, bar: FrameProgress) -> tuple[Checkpoint, list[int]]:
    """Finetune on keyframes of a log and write the weights: after a stop request, the best so far.

    Returns:
        The weights, and the sequence numbers of the frames they were fitted to.

    Raises:
        LogError, LabelError, FrameError, WeightsError, ConfigError: with what is wrong and the mend.
    """
    prepare_file(request.out)
    # First, so that a wrong path does not cost the reading of a log.
    start = None if request.from_scratch else load_checkpoint(request.weights or default_checkpoint_path())
    with open_log(request.log) as log:
        label_set = log.info.label_set
        if label_set is None:
            raise LabelError(f"{request.log}: has no label images; finetuning needs labelled keyframes")
        frames = choose_labelled(log, label_set, request, stop, bar)
    bar.start(100)

    def on_progress(progress: FinetuneProgress) -> None:
        note = f"step {progress.step} held-out loss {progress.held_out_loss:.3f}"
        bar.set(int(progress.fraction * 100), f"{note} accuracy {progress.held_out_accuracy * 100:.1f} %")

    checkpoint = finetune(
        frames,
        label_set,
        None if start is None else start.model,
        request.config,
        on_progress,
        lambda: stop,
        () if start is None else start.train_stamps_ns,
    )
    if stop and not checkpoint.recipe["steps"]:  # nothing learned: no reason to touch the file
        raise KeyboardInterrupt
    checkpoint.recipe["source"] = request.log.name
    save_checkpoint(checkpoint, request.out)
    return checkpoint, [f.seq for f in frames]


def choose_labelled(
    log: Log, label_set: LabelSet, request: FinetuneRequest, stop: StopRequest, bar: FrameProgress
) -> list[PosedFrame]:
    """The labelled frames that show most of what the log shows.

    Raises:
        LogError: fewer usable labelled frames than requested.
        KeyboardInterrupt: a stop request came.
    """
    candidates, numbers = [], []
    size: tuple[int, int] | None = None
    bar.start(len(log))
    for number in range(len(log)):
        bar.set(number + 1, "choosing keyframes")
        if stop:
            raise KeyboardInterrupt
        try:
            frame = log.frame(number)
            if frame.label is None:
                continue
            check_pose(frame.T_world_camera, f"frame seq={frame.seq}")
            label_set.to_channels(frame.label, f"frame seq={frame.seq}")
            size = size or (frame.intrinsics.width, frame.intrinsics.height)
            _check_size(frame, size)
        except (LogError, FrameError, LabelError) as error:
            _log.warning("frame_left_out", frame=number, reason=str(error))
            continue
        candidates.append(candidate_from_frame(frame))
        numbers.append(number)
    if len(candidates) < request.keyframes:
        raise LogError(
            f"{request.log}: {len(candidates)} of its {len(log)} frames have usable labels; "
            f"--keyframes {request.keyframes} is more than that"
        )
    return [log.frame(numbers[i]) for i in choose_keyframes(candidates, request.keyframes, request.config.seed)]


def _check_size(frame: PosedFrame, size: tuple[int, int]) -> None:
    """One finetuning takes views of one size.

    Raises:
        FrameError: another size.
    """
    k = frame.intrinsics
    if (k.width, k.height) != size:
        raise FrameError(f"frame seq={frame.seq}: {k.width}x{k.height}, but the first one is {size[0]}x{size[1]}")
