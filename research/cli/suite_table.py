"""The figures of a benchmark run as a table for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table

from semantic_mapper.replay.summary import percent

STILL_RISING = 0.01  # of mIoU in the last interval of a curve


def suite_table(found: Mapping[str, Any]) -> Table:
    """One column a weights file; rows that nothing was measured for are left out, classes come last."""
    table = Table(title=found["title"], title_justify="left")
    table.add_column("")
    entries: list[Mapping[str, Any]] = list(found["weights"].values())
    for name in found["weights"]:
        table.add_column(name, justify="right")
    for rows in (_VIEW_ROWS, _MAP_ROWS):
        for text, path, show in rows:
            values = [_dig(entry, path) for entry in entries]
            if any(v is not None for v in values):
                table.add_row(text, *("-" if v is None else show(v) for v in values))
    _add_curve(table, entries)
    classes = [_dig(entry, "figures.data_set.per_class") or {} for entry in entries]
    table.add_section()
    for name in dict.fromkeys(n for c in classes for n in c):
        table.add_row(f"IoU {name}", *(percent(c[name]) if name in c else "-" for c in classes))
    return table


def rows_table(found: Mapping[str, Any]) -> Table:
    """The field beside what its source views say without it."""
    columns = {"mIoU": "miou", "total accuracy": "total_accuracy", "average accuracy": "average_accuracy"}
    columns |= {"mIoU, interior": "interior_miou", "ECE": "ece"}
    return _plain_table("the same query views without learned fusion", columns, found["rows"])


def _plain_table(title: str, columns: Mapping[str, str], rows: Mapping[str, Any]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for column in columns:
        table.add_column(column, justify="right")
    for name, row in rows.items():
        values = [None if row is None else row[key] for key in columns.values()]
        table.add_row(_ROW_NAMES.get(name, name), *("-" if v is None else percent(v) for v in values))
    return table


def map_rows_table(found: Mapping[str, Any]) -> Table:
    """The fused map beside maps whose frames are classified one by one."""
    columns = {"points": "map_miou", "true surface": "surface_miou", "seen from frames": "cast_miou"}
    columns |= {"its frames": "views_miou", "ECE": "ece", "instances AP50": "instance_ap50"}
    columns |= {"found": "instance_recall", "right": "instance_precision", "PQ": "pq", "PQ things": "pq_things"}
    return _plain_table("mIoU of the map", columns, found["map_rows"])


def difference_lines(found: Mapping[str, Any]) -> list[str]:
    """One sentence a difference."""
    return [
        f"{d['first']} minus {d['second']}: {_points(d['observed'])} mIoU points, {_interval(d)}"
        for d in found["differences"]
        if d["observed"] is not None
    ]


def _interval(difference: Mapping[str, Any]) -> str:
    if difference["note"] is not None:
        return str(difference["note"])
    low, high = _points(difference["low"]), _points(difference["high"])
    return f"95 % interval {low} to {high} ({difference['scenes']} rooms, paired bootstrap)"


def _add_curve(table: Table, entries: Sequence[Mapping[str, Any]]) -> None:
    curves = [{point["share"]: point for point in entry["figures"]["curve"]} for entry in entries]
    shares = sorted({share for curve in curves for share in curve})
    if not shares:
        return
    table.add_section()
    table.add_row("time to 95 % of the last mIoU", *(_time_to_most(entry["figures"]) for entry in entries))
    for share in shares:
        cells = [_curve_cell(curve.get(share)) for curve in curves]
        table.add_row(f"mIoU after {percent(share)} of the budget" if share else "mIoU before fitting", *cells)


def _time_to_most(figures: Mapping[str, Any]) -> str:
    seconds, gain = figures["seconds_to_95_percent"], figures["last_gain"]
    if seconds is None:
        return "-"
    return f"{seconds:.0f} s" if gain is None or gain < STILL_RISING else f"{seconds:.0f} s (still rising)"


def _curve_cell(point: Mapping[str, Any] | None) -> str:
    if point is None or point["miou"] is None:
        return "-"
    spent = f" ({point['seconds']:.0f} s, {point['steps']:.0f} steps)" if point["share"] else ""
    return percent(point["miou"]) + spent


def _points(value: float) -> str:
    return f"{value * 100:+.1f}"


def _dig(entry: Mapping[str, Any], path: str) -> Any:
    value: Any = entry
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


_ROW_NAMES = {
    "own": "own image alone",
    "vote": "vote of the views",
    "vote_exact": "vote at exact depth",
    "oracle": "oracle over views",
    "unet": "U-Net",
}
_Rows = Sequence[tuple[str, str, Callable[[Any], str]]]

_VIEW_ROWS: _Rows = (
    ("field", "kind", str),
    ("rooms", "figures.rooms", str),
    ("query views", "figures.images", str),
    ("mIoU", "figures.data_set.miou", percent),
    ("total accuracy", "figures.data_set.total_accuracy", percent),
    ("average accuracy", "figures.data_set.average_accuracy", percent),
    ("pixels with an answer", "figures.data_set.coverage", percent),
    ("mIoU an image", "figures.per_image.miou", percent),
    ("total accuracy an image", "figures.per_image.total_accuracy", percent),
    ("average accuracy an image", "figures.per_image.average_accuracy", percent),
    ("PSNR", "figures.psnr_db", lambda v: f"{v:.2f} dB"),
    ("SSIM", "figures.ssim", lambda v: f"{v:.3f}"),
    ("depth, relative error", "figures.depth_abs_rel", lambda v: f"{v:.3f}"),
    ("depth, RMSE", "figures.depth_rmse_m", lambda v: f"{v:.3f} m"),
    ("mIoU, interior", "figures.interior_miou", percent),
    ("calibration error (ECE)", "figures.ece", percent),
    ("confidence of 14/15 or more", "figures.sure", percent),
    ("of these right", "figures.sure_right", percent),
    ("multi-view consistency", "figures.consistency", percent),
    ("distance of source views", "figures.baseline_m", lambda v: f"{v:.2f} m"),
    ("seen by some source view", "figures.seen", percent),
    ("labels carried by depth alone: mIoU", "figures.carried_miou", percent),
)
_MAP_ROWS: _Rows = (
    ("map: rooms", "map.rooms", str),
    ("map: mIoU of its points", "map.map_miou", percent),
    ("map: mIoU of its frames", "map.views_miou", percent),
    ("map: mIoU seen from its frames", "map.cast_miou", percent),
    ("map: mIoU of its frames there", "map.cast_views_miou", percent),
    ("map: mIoU of its points that frames see", "map.seen_miou", percent),
    ("map: mIoU of one frame each there", "map.one_frame_miou", percent),
    ("map: mIoU of its points, mean of rooms", "map.map_miou_mean_of_rooms", percent),
    ("map: mIoU an image, mean of rooms", "map.view_miou_mean_of_rooms", percent),
    ("map: mIoU at the true surface", "map.surface_miou", percent),
    ("map: calibration error (ECE)", "map.ece", percent),
    ("map: points at the true surface", "map.on_surface", percent),
    ("map: instances, AP50", "map.instance_ap50", percent),
    ("map: true instances found", "map.instance_recall", percent),
    ("map: found instances that are right", "map.instance_precision", percent),
    ("map: panoptic quality (PQ) seen from its frames", "map.pq", percent),
    ("map: SQ", "map.sq", percent),
    ("map: RQ", "map.rq", percent),
    ("map: PQ+", "map.pq_plus", percent),
    ("map: PQ of things", "map.pq_things", percent),
)
