"""Score several ways of labelling the frames of a log side by side, on the frames none of them was fitted to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from semantic_mapper.config import MapperConfig, convert_config, to_plain
from semantic_mapper.errors import FrameError, LabelError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.replay.evaluate.truth import TruthMapper
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig, WarpBaseline
from semantic_mapper.types import PosedFrame, UInt8

_log = get_logger(__name__)

Predictor = Callable[[PosedFrame], UInt8]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Metrics by method, and how many frames were scored, left out, and refused."""

    methods: dict[str, dict[str, Any]]
    scored: int
    excluded: int
    refused: int


def field_predictors(bundle: Mapper) -> dict[str, Predictor]:
    """The field as it maps (the frame itself is a source view) and for a novel view (the frame is none), by kind."""
    novel = _with_current_view(bundle.pipeline.config, False)
    pipeline = MappingPipeline(
        novel, make_field(bundle.checkpoint.model, novel), bundle.pipeline.label_set, anchors=bundle.checkpoint.anchors
    )
    kind = bundle.checkpoint.model.kind
    return {
        kind: lambda frame: bundle.pipeline.step(frame).label,
        f"{kind}, novel view": lambda frame: pipeline.step(frame).label,
    }


def baseline_predictors(
    keyframes: list[PosedFrame],
    label_set: LabelSet,
    seconds: float,
    seed: int,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, Predictor]:
    """The baselines fitted to the same labelled keyframes: a per-image U-Net (given ``seconds``) and carried labels."""
    unet = UNetBaseline(label_set, UNetConfig(seconds=seconds, seed=seed))
    steps = unet.fit(keyframes, on_progress)
    _log.info("unet_fitted", steps=steps, keyframes=len(keyframes))
    return {"per-image U-Net": unet.predict, "labels carried by depth": WarpBaseline(label_set, keyframes).predict}


def evaluate_frames(
    frames: Iterable[PosedFrame],
    predictors: Mapping[str, Predictor],
    stream_labels: LabelSet,
    label_set: LabelSet,
    exclude_stamps: frozenset[int],
    on_frame: Callable[[int], None] | None = None,
) -> Evaluation:
    """Run every predictor over every frame; frames in ``exclude_stamps`` are predicted but not scored."""
    truth_mapper = TruthMapper(stream_labels, label_set)
    confusions = {name: ConfusionMatrix(label_set) for name in predictors}
    scored = excluded = refused = 0
    for index, frame in enumerate(frames):
        where = f"frame seq={frame.seq}"
        try:
            predicted = {name: predict(frame) for name, predict in predictors.items()}
            if frame.stamp_ns in exclude_stamps:
                excluded += 1
            elif frame.label is not None:
                truth = truth_mapper.to_map_ids(frame.label, where)
                scored += 1
                for name, label in predicted.items():
                    confusions[name].update(truth, label, where)
        except (FrameError, LabelError) as error:
            refused += 1
            _log.error("frame_refused", seq=frame.seq, reason=str(error))
        if on_frame is not None:
            on_frame(index + 1)
    return Evaluation({n: asdict(c.metrics()) for n, c in confusions.items()}, scored, excluded, refused)


def _with_current_view(config: MapperConfig, use: bool) -> MapperConfig:
    plain = to_plain(config)
    plain["keyframes"]["use_current_view"] = use
    return convert_config(plain, MapperConfig, "mapper config")
