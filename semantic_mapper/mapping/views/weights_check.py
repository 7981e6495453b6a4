"""Whether other weights may take the place of those that a map is made with: looked at in small pieces."""

from __future__ import annotations

from collections.abc import Sequence

from semantic_mapper.errors import WeightsError
from semantic_mapper.fields.base import SemanticField, check_classes
from semantic_mapper.mapping.keyframes import Keyframe, KeyframeStore
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.views.view_renderer import ViewRenderer
from semantic_mapper.types import PosedFrame


class FieldTrial:
    """A field that may take the place of a pipeline's, which goes on mapping meanwhile.

    Args:
        pipeline: Changed by ``exchange`` alone.
        field: Encodes as the present one does, see ``fields.learned.encode_alike``.
        anchors: Labelled keyframes that it was finetuned on.
        frames: Mapped ones, in which it is compared with the map; none = it is not.

    Raises:
        WeightsError: other classes than the map's, or more anchors than the pipeline keeps keyframes.
    """

    def __init__(
        self,
        pipeline: MappingPipeline,
        field: SemanticField,
        anchors: Sequence[PosedFrame],
        frames: Sequence[PosedFrame],
    ) -> None:
        check_classes(field, pipeline.label_set)
        if len(anchors) > pipeline.config.keyframes.capacity:
            raise WeightsError(
                f"{len(anchors)} keyframes come with these weights, but only {pipeline.config.keyframes.capacity} are "
                "kept (keyframes.capacity)"
            )
        self._pipeline = pipeline
        self._field = field
        config = pipeline.config
        self._renderer = ViewRenderer(field, config.render, config.sampling)
        self._anchors = list(anchors)
        self._frames = list(frames)
        self._encoded: list[Keyframe] = []
        self._same = self._compared = 0

    @property
    def agreement(self) -> float | None:
        """Fraction of the pixels that the map is sure of which this field names as the map does; None = none."""
        return self._same / self._compared if self._compared else None

    def advance(self) -> bool:
        """Encode an anchor, or look at a frame: about the time of one step. True once nothing is left to do."""
        if len(self._encoded) < len(self._anchors):
            self._encoded.append(self._pipeline.encode_anchor(self._anchors[len(self._encoded)]))
        elif self._frames:
            keyframes = KeyframeStore(self._pipeline.config.keyframes)
            for keyframe in self._pipeline.keyframes.keyframes:
                if not keyframe.labelled:
                    keyframes.add(keyframe)
            keyframes.exchange_labelled(self._encoded)
            same, compared = self._pipeline.agreement(self._frames.pop(), self._renderer, keyframes)
            self._same += same
            self._compared += compared
        return not self._frames and len(self._encoded) == len(self._anchors)

    def exchange(self) -> None:
        """Put the field in the place of the present one; only when ``advance`` has come to its end."""
        self._pipeline.exchange_field(self._field, self._encoded)
