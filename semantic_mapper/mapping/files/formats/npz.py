"""Points as plain numpy arrays, with the names of their classes: ``numpy.load`` reads them without pickle."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints


def write_npz(path: Path, points: MapPoints, label_set: LabelSet, *, scale_known: bool = True) -> None:
    """Write xyz (N, 3) float32 metres in the world, rgb (N, 3) uint8, label (N,) uint8, confidence (N,) float32.

    Where depth was computed somewhere: measured (N,) bool, False there. Where lengths are not metres: scale, "unknown".

    And of the label set: label_ids (L,) uint8, label_names (L,) text, label_colors (L, 3) uint8, ignore_id, label_set
    (its name).

    Raises:
        MapError: the file cannot be written.
    """
    measured = {} if points.measured is None or points.measured.all() else {"measured": points.measured}
    with atomic_write(path, raises=MapError) as file:
        np.savez_compressed(
            file,
            xyz=points.xyz,
            rgb=points.rgb,
            label=points.label,
            confidence=points.confidence,
            label_ids=np.array(label_set.ids, np.uint8),
            label_names=np.array(label_set.names, np.str_),
            label_colors=np.array(label_set.colors, np.uint8).reshape(-1, 3),
            ignore_id=np.uint8(label_set.ignore_id),
            label_set=np.str_(label_set.name),
            allow_pickle=False,
            **measured,
            **({} if scale_known else {"scale": np.str_("unknown")}),
        )
