"""What two runs of one log are compared by, and how far they may be apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from semantic_mapper.config import AtLeastZero, Config


class Tolerances(Config, frozen=True):
    """The largest difference that is no difference, by field; ``inf`` = the field is not looked at.

    A replay repeats bit for bit on one machine with one number of threads. These defaults leave room for another CPU or
    number of threads, where convolutions round otherwise; what ought not to change at all has none.
    """

    infinite: ClassVar[bool] = True

    frames_published: AtLeastZero = 0  # frames
    frames_mapped: AtLeastZero = 0
    frames_dropped: AtLeastZero = 0
    frames_refused: AtLeastZero = 0
    labels_refused: AtLeastZero = 0
    frames_scored: AtLeastZero = 0
    refused_alone: AtLeastZero = 0  # frames that only one of the runs has refused, as far as their summaries list them
    miou: AtLeastZero = 0.005  # 0..1, of the rendered views
    total_accuracy: AtLeastZero = 0.005
    average_accuracy: AtLeastZero = 0.005
    image_miou: AtLeastZero = 0.005
    map_miou: AtLeastZero = 0.005  # of the map's surface
    class_iou: AtLeastZero = 0.02  # of the class whose IoU differs most
    voxel_size_m: AtLeastZero = 0  # metres; maps of other voxels still have a surface to compare
    classes: AtLeastZero = 0  # names that only one of the maps has
    blocks: AtLeastZero = 0.005  # share of all blocks that only one of the maps has
    surface_median_m: AtLeastZero = 0.001  # of the distances to the other surface, the larger of both ways
    surface_p95_m: AtLeastZero = 0.005
    surface_alone: AtLeastZero = 0.005  # share of a surface from which the other is more than a voxel away
    labels: AtLeastZero = 0.01  # share of the common surface with another class
    confidence: AtLeastZero = 0.01  # mean difference on the common surface


Unit = Literal["count", "share", "m"]


@dataclass(frozen=True, slots=True)
class FieldKind:
    """What a field's values are, and where they stand in a summary.

    Args:
        unit: Of its values.
        path: Dotted place in ``summary.json``; empty for what is measured on the maps.
    """

    unit: Unit
    path: str = ""


BITS = "bits"  # exact comparison only: it has no tolerance
FIELDS = {
    "frames_published": FieldKind("count", "frames.published"),
    "frames_mapped": FieldKind("count", "frames.fused"),
    "frames_dropped": FieldKind("count", "frames.dropped"),
    "frames_refused": FieldKind("count", "frames.refused"),
    "labels_refused": FieldKind("count", "frames.labels_refused"),
    "frames_scored": FieldKind("count", "frames.scored"),
    "refused_alone": FieldKind("count"),
    "miou": FieldKind("share", "metrics.miou"),
    "total_accuracy": FieldKind("share", "metrics.total_accuracy"),
    "average_accuracy": FieldKind("share", "metrics.average_accuracy"),
    "image_miou": FieldKind("share", "metrics_per_image.miou"),
    "map_miou": FieldKind("share", "metrics.map_miou"),
    "class_iou": FieldKind("share"),
    "voxel_size_m": FieldKind("m"),
    "classes": FieldKind("count"),
    "blocks": FieldKind("share"),
    "surface_median_m": FieldKind("m"),
    "surface_p95_m": FieldKind("m"),
    "surface_alone": FieldKind("share"),
    "labels": FieldKind("share"),
    "confidence": FieldKind("share"),
    BITS: FieldKind("count"),
}


def show(value: float | None, unit: Unit) -> str:
    """A value for people: 12, 3.4 %, 5.6 mm; "-" for None."""
    if value is None:
        return "-"
    if unit == "count":
        return f"{value:g}" if value < 1e5 else f"{value:,.0f}"
    return f"{value * 100:.2f} %" if unit == "share" else f"{value * 1000:.2f} mm"
