"""Score several ways of labelling the frames of a log side by side, on the frames none of them was fitted to."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from semantic_mapper.config import SegmenterConfig
from semantic_mapper.errors import FrameError, LabelError
from semantic_mapper.evaluation.metrics import ConfidenceScores, ConfusionMatrix
from semantic_mapper.evaluation.panoptic import PanopticImage
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.things import SEEN, PanopticTruth, thing_image
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.training.baselines import UNetBaseline, UNetConfig, WarpBaseline
from semantic_mapper.training.views import stack_sources, view_from_frame
from semantic_mapper.types import Float32, PosedFrame, UInt8

_log = get_logger(__name__)


class Opinion(NamedTuple):
    """What a method says of a frame."""

    label: UInt8  # (H, W) ids, the ignore id = unknown
    confidence: Float32 | None = None  # (H, W) their probabilities, None where the method has none
    likeliest: UInt8 | None = None  # (H, W) ids that these are of where ``label`` may be unknown for want of confidence


SURE = 0.9  # confidence of a pixel that a user would keep
MAP = "points of the map"  # the method whose figures are those of the fused map

Predictor = Callable[[PosedFrame], Opinion]
ThingTeller = Callable[[PosedFrame, UInt8], PanopticImage]  # things of a frame, given its classes (H, W)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Metrics by method, and how many frames were scored, left out, and refused, have pseudo labels, or are damaged.

    In addition to the figures of ``SegmentationMetrics`` a method has ``ece``, ``sure`` (fraction of the pixels above a
    confidence of 0.9), ``sure_right`` (of those), and ``open_set_auroc`` where some labels are of classes that it
    cannot name; all None without confidences. The map also has ``open_set_unknown``: the fraction of
    its voted points of such classes that it calls unknown (``voxel_map.unknown_below``), None without such points.
    """

    methods: dict[str, dict[str, Any]]
    scored: int
    excluded: int
    refused: int
    pseudo_labelled: int = 0
    damaged: int = 0
    weights: str = ""

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        return {name: getattr(self, name) for name in self.__slots__}


class _Scores:
    def __init__(self, label_set: LabelSet) -> None:
        self.confusion = ConfusionMatrix(label_set)
        self.confidence = ConfidenceScores()

    def add(self, truth: UInt8, found: Opinion, known: NDArray[np.bool_], where: str) -> None:
        """Count one image, or the points of a map; ``known`` are the pixels whose confidence counts."""
        self.confusion.update(truth, found.label, where)
        if found.confidence is not None:
            strange = truth == self.confusion.label_set.ignore_id
            right = (found.label if found.likeliest is None else found.likeliest) == truth
            self.confidence.update(found.confidence[known], right[known], strange[known])

    def figures(self) -> dict[str, Any]:
        sure, right = self.confidence.above(SURE)
        return asdict(self.confusion.metrics()) | {
            "ece": self.confidence.calibration_error,
            "sure": sure,
            "sure_right": right,
            "open_set_auroc": self.confidence.open_set_auroc,
        }


def field_predictors(mapper: Mapper) -> dict[str, Predictor]:
    """The field as it maps (the frame itself is a source view), for a novel view (the frame is not one, nor shown to a
    segmenter), and what its encoder says of the frame alone, where it has an opinion of single images."""
    config, model = mapper.pipeline.config, mapper.model
    keyframes = msgspec.structs.replace(config.keyframes, use_current_view=False)
    moving = msgspec.structs.replace(config.moving, classes=config.moving.classes and not config.segmenter.table)
    novel = msgspec.structs.replace(config, keyframes=keyframes, segmenter=SegmenterConfig(), moving=moving)
    pipeline = MappingPipeline(
        novel, make_field(mapper.weights, novel), mapper.pipeline.label_set, anchors=mapper.weights.anchors
    )

    def predictor(pipeline: MappingPipeline) -> Predictor:
        def mapped(frame: PosedFrame) -> Opinion:
            update = pipeline.step(frame)
            return Opinion(update.label, update.confidence)

        return mapped

    def of_image(frame: PosedFrame) -> Opinion:
        """What encoder and classifier make of the image by itself, at the size that the pipeline works at."""
        width = min(config.render.encode_width or frame.intrinsics.width, frame.intrinsics.width)
        view = view_from_frame(replace(frame, label=None), model.label_set, width)
        with torch.inference_mode():
            logits = model.source_logits(model.encode(stack_sources([view])))
            assert logits is not None  # it classifies images
            size = (frame.intrinsics.height, frame.intrinsics.width)
            large = functional.interpolate(logits.float(), size=size, mode="bilinear", align_corners=False)
            confidence, channel = torch.softmax(large[0], dim=0).max(dim=0)
        return Opinion(model.label_set.to_ids(channel.numpy()), confidence.numpy())

    found = {model.kind: predictor(mapper.pipeline), f"{model.kind}, novel view": predictor(pipeline)}
    return found | ({"own image alone": of_image} if model.classifies_images and model.kind != "unet" else {})


def thing_tellers(mapper: Mapper) -> dict[str, ThingTeller]:
    """The predictors of ``field_predictors`` that tell things apart by themselves, and how: those of boxes."""
    model = mapper.model
    return {model.kind: partial(thing_image, model)} if isinstance(model, Panoptic) else {}


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
    warp = WarpBaseline(label_set, keyframes)
    return {
        "per-image U-Net": lambda frame: Opinion(unet.predict(frame)),
        "labels carried by depth": lambda frame: Opinion(warp.predict(frame)),
    }


def evaluate_frames(
    frames: Iterable[PosedFrame],
    predictors: Mapping[str, Predictor],
    stream_labels: LabelSet,
    label_set: LabelSet,
    exclude_stamps: frozenset[int],
    on_frame: Callable[[int], None] | None = None,
    voxel_map: VoxelMap | None = None,
    panoptic: PanopticTruth | None = None,
    things: Mapping[str, ThingTeller] = {},
) -> Evaluation:
    """Run every predictor over every frame; frames in ``exclude_stamps`` are predicted but not scored,
    and so are those with pseudo labels.

    ``voxel_map``, where it is given and one of the predictors fills it, is scored in the end as the method ``MAP``: its
    points against the majority of the labels of the frames with depth that see them. With ``panoptic``, which the
    scored frames are added to, it is also scored as the method ``SEEN``: with its things, as those frames see it. The
    predictors that ``things`` names are, too.
    """
    surface = SurfaceTruth(stream_labels)
    truth_mapper = TruthMapper(stream_labels, label_set)
    scores = {name: _Scores(label_set) for name in predictors}
    scored = excluded = refused = pseudo = 0
    for index, frame in enumerate(frames):
        where = f"frame seq={frame.seq}"
        try:
            predicted = {name: predict(frame) for name, predict in predictors.items()}
            if frame.stamp_ns in exclude_stamps:
                excluded += 1
            elif frame.label is not None and frame.label_is_pseudo:
                pseudo += 1
            elif frame.label is not None:
                truth = truth_mapper.to_map_ids(frame.label, where)
                scored += 1
                if voxel_map is not None:
                    surface.add(frame)
                if panoptic is not None:
                    found = {name: partial(tell, frame, predicted[name].label) for name, tell in things.items()}
                    panoptic.add(frame, truth, found)
                for name, opinion in predicted.items():
                    scores[name].add(truth, opinion, frame.label != stream_labels.ignore_id, where)
        except (FrameError, LabelError) as error:
            refused += 1
            _log.error("frame_refused", seq=frame.seq, reason=str(error))
        if on_frame is not None:
            on_frame(index + 1)
    methods = {name: of.figures() for name, of in scores.items()}
    if voxel_map is not None:
        points = voxel_map.points()
        labels = surface.labels_at(points.xyz)
        labelled = labels != stream_labels.ignore_id
        if labelled.any():
            truth, voted = truth_mapper.to_map_ids(labels, MAP), labelled & (points.confidence > 0)
            of_map = _Scores(label_set)
            likeliest = voxel_map.points(unknown_below=0).label
            of_map.add(truth, Opinion(points.label, points.confidence, likeliest), voted, MAP)
            strange = points.label[(truth == label_set.ignore_id) & voted]
            rejected = float((strange == label_set.ignore_id).mean()) if len(strange) else None
            methods[MAP] = of_map.figures() | {"open_set_unknown": rejected}
        if panoptic is not None:
            methods[SEEN] = {**panoptic.score(voxel_map)}
            for name, figures in panoptic.score_methods().items():
                methods[name] |= figures
    return Evaluation(methods, scored, excluded, refused, pseudo)
