"""Figures of a run from its records: one weights file alone, and two of them compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from research.evaluation.bootstrap import paired_bootstrap
from research.evaluation.consistency import Agreement
from research.evaluation.depth_error import DepthErrors
from research.evaluation.instances import InstanceMatch, InstanceMatches, average_precision
from research.plots import Curve, Panel, draw_panels
from research.scenes.suite import ROOMS_SUITE
from research.suites.records import BaselineRecord, CurvePoint, ImageRecord, MapRecord, RoomRecord
from research.suites.scoring import as_counts, from_rows
from semantic_mapper.evaluation.metrics import ConfusionMatrix, calibration_error
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticMetrics
from semantic_mapper.types import UInt8

ONE_ROOM = "no interval: a bootstrap needs at least 2 rooms"


def view_figures(records: Sequence[RoomRecord]) -> dict[str, Any]:
    """All figures of one weights file over its rooms, as plain data; None where nothing could be measured."""
    confusions = [from_rows(r.confusion) for r in records]
    images = [image for r in records for image in r.images]
    agreement = sum((Agreement(r.agreeing, r.compared) for r in records), Agreement())
    depth = sum((DepthErrors(i.depth.relative_sum, i.depth.square_sum, i.depth.count) for i in images), DepthErrors())
    return {
        "rooms": len(records),
        "images": len(images),
        "data_set": asdict(_summed(confusions).metrics()),
        "per_image": {
            name: _mean([getattr(i, name) for i in images])
            for name in ("miou", "total_accuracy", "average_accuracy", "coverage")
        },
        "psnr_db": _mean([i.psnr_db for i in images]),
        "ssim": _mean([i.ssim for i in images]),
        "depth_abs_rel": depth.abs_rel,
        "depth_rmse_m": depth.rmse_m,
        "ece": _ece(records),
        **_surest(records),
        "consistency": agreement.fraction,
        "interior_miou": _summed([from_rows(r.interior) for r in records]).metrics().miou,
        "by_condition": {
            name: _mean([i.miou for i in images if i.condition == name])
            for name in sorted({i.condition for i in images})
        },
        "baseline_m": _mean([i.baseline_m for i in images]),
        "seen": _mean([i.seen for i in images]),
        "per_room_miou": {str(r.room): c.metrics().miou for r, c in zip(records, confusions, strict=True)},
        "carried_miou": _carried(records),
        "curve": _curve(records),
        "seconds_to_95_percent": _seconds_to_most(_curve(records)),
        "last_gain": _last_gain(_curve(records)),
    }


def row_figures(records: Sequence[RoomRecord] | Sequence[BaselineRecord]) -> dict[str, float | None]:
    """One row of the comparison table: a field, or one baseline, over its rooms."""
    total = _summed([from_rows(r.confusion) for r in records]).metrics()
    return {
        "miou": total.miou,
        "total_accuracy": total.total_accuracy,
        "average_accuracy": total.average_accuracy,
        "interior_miou": _summed([from_rows(r.interior) for r in records]).metrics().miou,
        "ece": _ece(records),
    }


def comparison_rows(records: Sequence[RoomRecord]) -> dict[str, dict[str, float | None]]:
    """``row_figures`` of each baseline that all of the rooms have, by name."""
    return {name: row_figures([r.rows[name] for r in records]) for name in _common_rows(records)}


def compare_with_baselines(records: Sequence[RoomRecord], *, seed: int = 0) -> dict[str, dict[str, Any]]:
    """Field minus baseline, by baseline, as ``compare``; empty without rooms."""
    own = [from_rows(r.confusion) for r in records]
    return {
        name: _difference(own, [from_rows(r.rows[name].confusion) for r in records], seed)
        for name in _common_rows(records)
    }


def compare_with_carried(records: Sequence[RoomRecord], *, seed: int = 0) -> dict[str, Any] | None:
    """Field minus the keyframes' labels carried over by depth, as ``compare``; None where any room has none."""
    carried = [from_rows(r.carried) for r in records if r.carried is not None]
    if not carried or len(carried) < len(records):
        return None
    return _difference([from_rows(r.confusion) for r in records], carried, seed)


def _common_rows(records: Sequence[RoomRecord]) -> list[str]:
    return [name for name in records[0].rows if all(name in r.rows for r in records)] if records else []


def map_figures(records: Sequence[MapRecord]) -> dict[str, Any]:
    """Figures of the fused maps of one weights file over its rooms."""
    at_points = [from_rows(r.confusion) for r in records]
    return {
        "rooms": len(records),
        "map_miou": _summed(at_points).metrics().miou,
        "surface_miou": _summed([from_rows(r.surface_confusion) for r in records]).metrics().miou,
        "views_miou": _summed([from_rows(r.view_confusion) for r in records]).metrics().miou,
        "cast_miou": _summed([from_rows(r.cast_confusion) for r in records]).metrics().miou,
        "cast_views_miou": _summed([from_rows(r.cast_view_confusion) for r in records]).metrics().miou,
        "seen_miou": _summed([from_rows(r.seen_confusion) for r in records]).metrics().miou,
        "one_frame_miou": _summed([from_rows(r.one_frame_confusion) for r in records]).metrics().miou,
        "map_miou_mean_of_rooms": _mean([c.metrics().miou for c in at_points]),
        "view_miou_mean_of_rooms": _mean([r.view_miou for r in records]),
        "on_surface": _mean([r.on_surface for r in records]),
        "ece": _ece(records),
        **_instance_figures(records),
        **_panoptic_figures(records),
        "per_room": {
            str(r.room): {"map_miou": c.metrics().miou, "view_miou": r.view_miou}
            for r, c in zip(records, at_points, strict=True)
        },
    }


def map_row_figures(records: Sequence[MapRecord]) -> dict[str, float | None]:
    """One row of the comparison of maps."""
    found = map_figures(records)
    names = ("map_miou", "surface_miou", "cast_miou", "views_miou", "ece", "instance_ap50", "instance_recall")
    return {name: found[name] for name in (*names, "instance_precision", "pq", "pq_things")}


def _instance_figures(records: Sequence[MapRecord]) -> dict[str, Any]:
    """Of instances with an IoU of half; None where some room has none recorded."""
    matches = [
        InstanceMatches(tuple(InstanceMatch(*found) for found in r.instances.found), r.instances.truth)
        for r in records
        if r.instances is not None
    ]
    if len(matches) < len(records):
        return dict.fromkeys(("instance_ap50", "instance_recall", "instance_precision", "instance_ap50_by_class"))
    figures = average_precision(matches, ROOMS_SUITE.label_set)
    return {
        "instance_ap50": figures.ap,
        "instance_recall": figures.recall,
        "instance_precision": figures.precision,
        "instance_ap50_by_class": figures.per_class,
    }


def _panoptic_figures(records: Sequence[MapRecord]) -> dict[str, Any]:
    """Panoptic quality over all frames of all rooms; None where some room has none recorded."""
    kept = [as_counts(r.panoptic) for r in records if r.panoptic is not None]
    known = len(kept) == len(records)
    figures = sum(kept, PanopticCounts(ROOMS_SUITE.label_set)).metrics() if known else PanopticMetrics()
    names = ("pq", "sq", "rq", "pq_plus", "pq_things", "pq_stuff")
    per_class = {name: of.pq for name, of in figures.per_class.items()} if known else None
    return {name: getattr(figures, name) for name in names} | {"pq_by_class": per_class}


def compare_maps(first: Sequence[MapRecord], second: Sequence[MapRecord], *, seed: int = 0) -> dict[str, Any] | None:
    """Difference in mIoU of the maps' points, ``first`` minus ``second``, as ``compare``."""
    return _compare(first, second, seed)


def compare_surfaces(first: Sequence[MapRecord], second: Sequence[MapRecord], *, seed: int = 0) -> dict[str, Any]:
    """Difference in mIoU at the true surface of the same rooms, as ``compare``."""
    a, b = ([from_rows(r.surface_confusion) for r in side] for side in (first, second))
    return _difference(a, b, seed)


def worst_room(first: Sequence[MapRecord], second: Sequence[MapRecord]) -> tuple[int, float]:
    """The room where ``first`` falls behind ``second`` the most, and the difference in mIoU of the maps' points."""
    changes: list[tuple[float, int]] = []
    for a, b in zip(first, second, strict=True):
        one, other = (from_rows(r.confusion).metrics().miou for r in (a, b))
        changes.append(((one or 0.0) - (other or 0.0), a.room))
    change, room = min(changes)
    return room, change


def compare(first: Sequence[RoomRecord], second: Sequence[RoomRecord], *, seed: int = 0) -> dict[str, Any] | None:
    """Difference in data-set mIoU, ``first`` minus ``second``, over the rooms of both; None where they share none.

    Returns:
        The fields of ``Difference``, and a ``note``. Of one room ``mean``, ``low`` and ``high`` are None and the note
        says why; otherwise the note is None.
    """
    return _compare(first, second, seed)


def _compare(
    first: Sequence[RoomRecord] | Sequence[MapRecord], second: Sequence[RoomRecord] | Sequence[MapRecord], seed: int
) -> dict[str, Any] | None:
    others = {r.room: r for r in second}
    both = [(r, others[r.room]) for r in first if r.room in others]
    if not both:
        return None
    a, b = ([from_rows(r.confusion) for r in side] for side in zip(*both, strict=True))
    return _difference(a, b, seed)


def _difference(first: Sequence[ConfusionMatrix], second: Sequence[ConfusionMatrix], seed: int) -> dict[str, Any]:
    if len(first) > 1:
        return {**asdict(paired_bootstrap(first, second, seed=seed)), "note": None}
    a, b = first[0].metrics().miou, second[0].metrics().miou
    observed = None if a is None or b is None else a - b
    return {"observed": observed, "mean": None, "low": None, "high": None, "scenes": 1, "note": ONE_ROOM}


def draw_fit_curves(figures: Mapping[str, Mapping[str, Any]], title: str) -> UInt8 | None:
    """mIoU against the seconds that fitting a room took, (H, W, 3) RGB; None where nothing was fitted.

    Args:
        figures: ``view_figures`` of each entry, by name. Labels that depth alone carries over, the same for all of
            them, are a line of their own.
        title: Of the picture.
    """
    points = {
        n: [(p["seconds"], 100 * p["miou"]) for p in f["curve"] if p["miou"] is not None] for n, f in figures.items()
    }
    curves = [Curve(name, found, marked=True) for name, found in points.items() if len(found) > 1]
    if not curves:
        return None
    carried = next((f["carried_miou"] for f in figures.values() if f["carried_miou"] is not None), None)
    if carried is not None:
        last = max(curve.points[-1][0] for curve in curves)
        curves.append(Curve("labels carried by depth", [(0.0, 100 * carried), (last, 100 * carried)]))
    return draw_panels(title, [Panel("", "mIoU, %", "seconds of fitting a room", curves)], size=(1000, 520))


def _summed(confusions: Sequence[ConfusionMatrix]) -> ConfusionMatrix:
    label_set = confusions[0].label_set if confusions else ROOMS_SUITE.label_set
    return sum(confusions, ConfusionMatrix(label_set))


def _ece(records: Sequence[RoomRecord] | Sequence[MapRecord] | Sequence[BaselineRecord]) -> float | None:
    if not records:
        return None
    count = np.array([r.calibration.count for r in records], np.int64)
    confidence = np.array([r.calibration.confidence for r in records], np.float64)
    right = np.array([r.calibration.right for r in records], np.float64)
    return calibration_error(count.sum(axis=0), confidence.sum(axis=0), right.sum(axis=0))


def _surest(records: Sequence[RoomRecord]) -> dict[str, float | None]:
    """Fraction of the pixels in the last bin of confidence (14/15 and more), and how many of those are right."""
    pixels = sum(sum(r.calibration.count) for r in records)
    sure = sum(r.calibration.count[-1] for r in records)
    right = sum(r.calibration.right[-1] for r in records)
    return {"sure": sure / pixels if pixels else None, "sure_right": right / sure if sure else None}


def _carried(records: Sequence[RoomRecord]) -> float | None:
    """mIoU of the keyframes' labels carried over by depth alone; None where any room has none."""
    rows = [r.carried for r in records if r.carried is not None]
    return _summed([from_rows(r) for r in rows]).metrics().miou if rows and len(rows) == len(records) else None


def _curve(records: Sequence[RoomRecord]) -> list[dict[str, Any]]:
    """mIoU over all rooms against the mean seconds and steps that the fitting of a room took."""
    shares = sorted({point.share for r in records for point in r.curve})
    points: list[list[CurvePoint]] = [[p for r in records for p in r.curve if p.share == share] for share in shares]
    return [
        {
            "share": share,
            "seconds": round(float(np.mean([p.seconds for p in at])), 1),
            "steps": round(float(np.mean([p.steps for p in at])), 1),
            "miou": _summed([from_rows(p.confusion) for p in at]).metrics().miou,
        }
        for share, at in zip(shares, points, strict=True)
    ]


def _seconds_to_most(curve: Sequence[dict[str, Any]], most: float = 0.95) -> float | None:
    """Seconds of the first point of the curve that reaches this share of its last mIoU; None without a curve."""
    final = curve[-1]["miou"] if curve else None
    if final is None:
        return None
    return next(p["seconds"] for p in curve if p["miou"] is not None and p["miou"] >= most * final)


def _last_gain(curve: Sequence[dict[str, Any]]) -> float | None:
    """mIoU that the last interval of the curve brought: where it is much, the curve had not come to its end."""
    if len(curve) < 2 or curve[-1]["miou"] is None or curve[-2]["miou"] is None:
        return None
    return curve[-1]["miou"] - curve[-2]["miou"]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def image_note(image: ImageRecord) -> str:
    """What is said of one view in a picture."""
    return "no truth" if image.miou is None else f"mIoU {100 * image.miou:.0f} %"
