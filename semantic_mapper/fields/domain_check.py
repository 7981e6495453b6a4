"""Whether pictures are like the rendered rooms that weights learned from (out-of-distribution detection).

Measured is the Mahalanobis distance of a picture's features from those of training rooms: the coarsest ones of the
frozen ImageNet backbone, averaged over the picture. Photographs of rooms lie at 1.3 to 1.6, landscapes, streets and
animals at 2 to 6 (``docs/model-card.md``). The encoder computes these features anyway."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from semantic_mapper.fields.checkpoint import SHIPPED, Checkpoint
from semantic_mapper.fields.encoder import EfficientNetLite0
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float32

STATISTICS = SHIPPED / "rooms-pictures.npz"  # ``research/experiments/open_set.py`` makes it
SUITE = "rooms"  # of the training that they are of
WIDTH = 160  # of the pictures that they are of; features of other sizes differ, and are not judged
UNLIKE = 1.9  # distance from which on a picture is unlike training rooms, whose own lie round 1
MOSTLY = 0.5  # fraction of the pictures, from which on this is worth a warning
LEAST = 5  # pictures, before anything is said

_log = get_logger(__name__)


class DomainCheck:
    """Judges the pictures that networks encode; changes nothing. ``pictures`` were judged, ``unlike`` of them are
    unlike those of the training, whose features have this ``mean`` (D,). ``whiten`` (D, D) makes the covariance of
    these one over D."""

    def __init__(self, backbones: Sequence[EfficientNetLite0], mean: Float32, whiten: Float32) -> None:
        self._mean, self._whiten = torch.from_numpy(mean), torch.from_numpy(whiten)
        self._feature: torch.Tensor | None = None
        self._said = False
        self.pictures = self.unlike = 0
        for backbone in backbones:
            backbone.register_forward_hook(self._keep)

    def note(self) -> None:
        """Judge the picture that was encoded last."""
        if self._feature is None:
            return
        self.pictures += 1
        self.unlike += self.distance(self._feature) > UNLIKE
        if self.warning and not self._said:
            self._said = True
            _log.warning("pictures_unlike_training", reason=self.warning)

    def distance(self, feature: torch.Tensor) -> float:
        """Of a picture with these features (D,)."""
        offset = feature - self._mean
        return float((self._whiten @ offset).square().sum().sqrt())

    @property
    def warning(self) -> str:
        """What is wrong where most pictures are unlike those of the training; else empty."""
        if self.pictures < LEAST or self.unlike <= MOSTLY * self.pictures:
            return ""
        return (
            f"{self.unlike} of {self.pictures} pictures are unlike the rooms that the weights learned: classes cannot "
            "be trusted; finetune on labelled keyframes of such a place (`semantic-mapper finetune`)"
        )

    def _keep(self, _module: Any, inputs: tuple[torch.Tensor], maps: list[torch.Tensor]) -> None:
        judged = inputs[0].shape[-1] == WIDTH
        self._feature = maps[-1][-1].float().mean((1, 2)).cpu() if judged else None


def find_domain_check(checkpoint: Checkpoint, network: LearnedField) -> DomainCheck | None:
    """The check of what ``network``, the checkpoint's or a copy, encodes. None for weights that did not learn from
    rooms, or not with the backbone that ships; finetuned weights know a place of their own."""
    encoder = network.image_encoder
    if encoder is None or str(checkpoint.recipe.get("suite")).split(" ")[0] != SUITE:
        return None
    backbones = list(encoder.backbones())
    with np.load(STATISTICS) as kept:
        if {backbone_digest(backbone) for backbone in backbones} != {str(kept["backbone"])}:
            return None
        return DomainCheck(backbones, kept["mean"], kept["whiten"])


def backbone_digest(backbone: EfficientNetLite0) -> str:
    """What tells its weights from others."""
    found = hashlib.sha256()
    for tensor in backbone.state_dict().values():
        found.update(tensor.cpu().numpy().tobytes())
    return found.hexdigest()[:32]
