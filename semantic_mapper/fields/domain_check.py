"""Whether pictures are like the rendered rooms that weights learned from (out-of-distribution detection).

Measured is the Mahalanobis distance of a picture's features from those of training rooms: the coarsest ones of the
frozen ImageNet backbone, averaged over the picture. Photographs of rooms lie at 1.3 to 1.6, landscapes, streets and
animals at 2 to 6 (``docs/model-card.md``). The encoder computes these features anyway."""

import hashlib
from typing import Any

import numpy as np

from semantic_mapper.fields.base import StreamField
from semantic_mapper.fields.streaming import StreamingSRay
from semantic_mapper.fields.weights import SHIPPED, WeightsFile
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float32

STATISTICS = SHIPPED / "rooms-pictures.npz"  # ``research/experiments/open_set.py`` makes it
SUITE = "rooms"  # of the training that they are of
UNLIKE = 1.9  # distance from which on a picture is unlike training rooms, whose own lie round 1
MOSTLY = 0.5  # fraction of the pictures, from which on this is worth a warning
LEAST = 5  # pictures, before anything is said

_log = get_logger(__name__)


class DomainCheck:
    """Judges the pictures that a ``field`` encodes; changes nothing. ``pictures`` were judged, ``unlike`` are unlike
    those of the training, whose features have this ``mean`` (D,); ``whiten`` (D, D) makes their covariance 1/D."""

    def __init__(self, field: StreamingSRay, mean: Float32, whiten: Float32) -> None:
        self._field, self._mean, self._whiten = field, mean, whiten
        self._said = False
        self.pictures = self.unlike = 0

    def note(self) -> None:
        """Judge the picture that was encoded last; one of another size than those of the training is not."""
        feature = self._field.picture
        if feature is None:
            return
        self.pictures += 1
        self.unlike += self.distance(feature) > UNLIKE
        if self.warning and not self._said:
            self._said = True
            _log.warning("pictures_unlike_training", reason=self.warning)

    def distance(self, feature: Float32) -> float:
        """Of a picture with these features (D,)."""
        return float(np.linalg.norm(self._whiten @ (feature - self._mean)))

    @property
    def warning(self) -> str:
        """What is wrong where most pictures are unlike those of the training; else empty."""
        if self.pictures < LEAST or self.unlike <= MOSTLY * self.pictures:
            return ""
        return (
            f"{self.unlike} of {self.pictures} pictures are unlike the rooms that the weights learned: classes cannot "
            "be trusted; finetune on labelled keyframes of such a place (`semantic-mapper finetune`)"
        )


def find_domain_check(weights: WeightsFile, field: StreamField[Any]) -> DomainCheck | None:
    """The check of what a field of these weights encodes. None for weights that did not learn from rooms, or not with
    the backbone that ships, or of torch; finetuned weights know a place of their own."""
    if not isinstance(field, StreamingSRay) or str(weights.recipe.get("suite")).split(" ")[0] != SUITE:
        return None
    with np.load(STATISTICS) as kept:
        if backbone_digests(weights) != {str(kept["backbone"])}:
            return None
        return DomainCheck(field, kept["mean"], kept["whiten"])


def backbone_digests(weights: WeightsFile) -> set[str]:
    """What tells the weights of its backbones from others."""
    found: dict[str, Any] = {}
    for name, tensor in sorted(weights.tensors.items()):
        network, backbone, _ = name.partition(".backbone.")
        if backbone:
            found.setdefault(network, hashlib.sha256()).update((tensor + 0).tobytes())  # -0.0 is 0.0
    return {digest.hexdigest()[:32] for digest in found.values()}
