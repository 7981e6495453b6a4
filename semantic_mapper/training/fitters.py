"""Which function fits which kind of field to a scene."""

from __future__ import annotations

from semantic_mapper.fields.grid.field import GridField
from semantic_mapper.fields.irt import IRT
from semantic_mapper.fields.panoptic import Panoptic
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.irt import fit_irt
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.training.scene_fit import Fitter, fit_scene

# Kinds that are fitted to a scene in a way of their own. Kinds that build on GridField add a row.
FITTERS: dict[str, Fitter] = {GridField.kind: fit_scene, IRT.kind: fit_irt, Panoptic.kind: fit_panoptic}


def fitter_of(kind: str) -> Fitter:
    """The fitter of a kind of field; ``finetune`` where it has none of its own."""
    return FITTERS.get(kind, finetune)
