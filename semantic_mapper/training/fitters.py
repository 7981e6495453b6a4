"""Which function fits which kind of field to a scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import OnProgress
from semantic_mapper.training.grid_fit import fit_scene
from semantic_mapper.training.irt import fit_irt
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.types import PosedFrame


class Fitter(Protocol):
    """As ``finetune``: frames without labels help with geometry, those with labels say the classes."""

    def __call__(
        self,
        frames: Sequence[PosedFrame],
        label_set: LabelSet,
        start: LearnedField | None,
        config: FinetuneConfig,
        on_progress: OnProgress | None = None,
        stopped: Callable[[], object] = bool,
        seen_stamps_ns: Iterable[int] = (),
    ) -> Checkpoint:
        """Fit to a scene."""
        ...


# Kinds that are fitted to a scene in a way of their own. Kinds that build on GridField add a row.
FITTERS: dict[str, Fitter] = {GridField.kind: fit_scene, IRT.kind: fit_irt, Panoptic.kind: fit_panoptic}


def fitter_of(kind: str) -> Fitter:
    """The fitter of a kind of field; ``finetune`` where it has none of its own."""
    return FITTERS.get(kind, finetune)
