"""The summary of a run: read, and as a table for people; several side by side."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from semantic_mapper.errors import ConfigError
from semantic_mapper.files import read_regular
from semantic_mapper.mapping.map_types import SCALE_FIX, voxel_size_text
from semantic_mapper.plain_text import counted

SUMMARY_FILE = "summary.json"
MAX_SUMMARY_BYTES = 1 << 24


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary in a result folder. Raises ConfigError: it is missing or damaged."""
    path = folder / SUMMARY_FILE
    try:
        summary = json.loads(read_regular(path, MAX_SUMMARY_BYTES))
    except (OSError, ValueError, RecursionError, ConfigError) as error:
        raise ConfigError(
            f"{path}: cannot be read; give a folder that `semantic-mapper map` has written ({error})"
        ) from error
    if not isinstance(summary, dict) or "frames" not in summary or "metrics" not in summary:
        raise ConfigError(f"{path}: is not the summary of a replay")
    return summary


def dig(summary: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted place of a summary, None where it has no such place; the whole for ""."""
    value: Any = summary
    for key in path.split(".") if path else ():
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def figures_table(
    title: str,
    records: Mapping[str, Mapping[str, Any]],
    rows: Sequence[tuple[str, str, Callable[[Any], str]]],
    by_name: Sequence[tuple[str, str, Callable[[Any], str]]],
) -> Table:
    """One column a record, by its name. ``rows`` are a head, the dotted place of a value and how it is shown; those of
    ``by_name`` are a head and the place of values with names of their own, a row each. Empty rows are left out."""
    table = Table("", title=title, title_justify="left")
    for name in records:
        table.add_column(name, justify="right")

    def add(head: str, values: Sequence[Any], show: Callable[[Any], str]) -> None:
        table.add_row(head, *("-" if value is None else show(value) for value in values))

    for head, path, show in rows:
        values = [dig(record, path) for record in records.values()]
        if any(value is not None for value in values):
            add(head, values, show)
    for head, path, show in by_name:
        found = [dig(record, path) or {} for record in records.values()]
        table.add_section()
        for name in dict.fromkeys(name for values in found for name in values):
            shown = name.replace("_", " ") if head.endswith(":") else name  # no class is renamed
            add(f"{head} {shown}", [values.get(name) for values in found], show)
    return table


def summary_table(summaries: Mapping[str, Mapping[str, Any]]) -> Table:
    """One column a summary, by name."""
    return figures_table("map", summaries, _ROWS, _ROWS_BY_NAME)


def ending(summary: Mapping[str, Any], out: Path) -> list[str]:
    """What became of a run, what to know of it, where pictures and map are, a line each; the report has more."""
    ms, unknown, scored = (dig(summary, path) for path in ("latency_ms.p50", "map.unknown", "metrics.miou"))
    mapped = f"{summary['frames']['fused']} of {counted(summary['frames']['published'], 'frame')}"
    times = "" if ms is None else f", {_ms(ms)} each (p95 {_ms(dig(summary, 'latency_ms.p95'))})"
    known = [f"{percent(unknown)} unknown"] if unknown else []
    if scored is not None:
        known.append(f"{percent(scored)} mIoU, {percent(dig(summary, 'metrics.total_accuracy'))} of pixels right")
    lines = [
        f"{mapped} of {summary['source']} mapped{times}",
        f"{dig(summary, 'map.surface_points'):,} surface points in voxels of {_voxel_size(summary)}",
        f"classes by {dig(summary, 'weights.file')}{': ' if known else ''}{'; '.join(known)}",
    ]
    if (disagreement := dig(summary, "pose_check.depth_disagreement")) is not None:
        lines.append(f"poses and depth disagree in {percent(disagreement)} of what two frames see")
    if scene := summary.get("scene"):
        lines.append(f"known to the weights: {_scene_known(scene)}")
    lines += notes(summary)
    for names, text in _RESULTS.items():
        if there := [name for name in names if (out / name).exists()]:
            lines.append(text.format(" and ".join([str(out / there[0]), *there[1:]])))
    return lines


def notes(summary: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures has to know."""
    frames, (empty, *others) = summary["frames"], [dig(summary, place) or "" for place in _WARNINGS]
    warnings = [empty, *(text for text in others if text not in empty)]  # it says why
    lines = [f"warning: {warning}" for warning in (*warnings, *(dig(summary, "pictures.notes") or ())) if warning]
    for path, text in _DEPTH_NOTES.items():
        fraction = dig(summary, path)
        if fraction and (path, fraction) != ("map.computed", 1):  # the frames say it
            lines.append(text.format(percent(fraction)))
    unused = frames.get("published", 0) - sum(frames.get(name, 0) for name in ("dropped", "refused", "fused"))
    if unused and dig(summary, "depth.computed_fraction"):
        lines.append(f"{counted(unused, 'frame')} added nothing to the map: no depth was found, or it was too unsure")
    if summary.get("scale") == "unknown":
        lines.append(f"scale: unknown; lengths of this map are not metres, what needs metres is refused: {SCALE_FIX}")
    elif scale := summary.get("scale_from"):
        lines.append(f"scale: from {scale}; an error there scales the whole map")
    reason = f"refused; the first: {summary['refusals'][0]['reason'] if summary.get('refusals') else ''}"
    for name, text in {**_FRAME_NOTES, "refused": reason}.items():
        if frames.get(name):
            lines.append(f"{counted(frames[name], 'frame')} {text}")
    if damaged := summary.get("damaged_stretches"):
        lines.append(f"{counted(len(damaged), 'damaged stretch', 'damaged stretches')} of the log passed over")
    if unfinished := dig(summary, "map.unfinished_correction"):
        lines.append(unfinished)
    if stopped := summary.get("stopped_by"):
        lines.append(f"stopped by {stopped}: the results are those of the frames so far")
    if restarted := summary.get("restarted"):
        lines.append(f"{restarted}; frames are counted since then")
    return lines


_WARNINGS = (
    "map.nearly_empty",
    "pose_check.warning",
    "depth.range_warning",
    "pictures.unlike_training_warning",
    "map.moving_warning",
)
_RESULTS = {
    ("report.html", "overview.png"): "pictures: {}",
    ("map.npz", "map.ply"): "map: {}, for `query`, `view`, `export`",
}
_DEPTH_NOTES = {
    "depth.computed_fraction": "depth: computed from the pictures for {} of the frames: less exact than a sensor's, "
    "with holes in plain walls",
    "depth.rendered_fraction": "depth: rendered by the field for {} of the frames, which have no sensor depth; "
    "geometry is less exact than with a depth sensor",
    "map.computed": "surface: {} of its points were computed, not measured by a sensor; `export --min-weight 1` leaves "
    "them out",
}
_FRAME_NOTES = {
    "left_out": "of the film left out by the import; its report says why",
    "excluded_from_scores": "left out of the scores: weights were finetuned on them",
    "pseudo_labels": "not scored: their labels are pseudo labels, which weights have rendered (`autolabel`)",
    "labels_refused": "mapped, but not scored: labels that cannot be used",
}


def percent(value: float) -> str:
    """0.1234 -> 12.3 %."""
    return f"{value * 100:.1f} %"


def _ms(value: float) -> str:
    return f"{value:.0f} ms"


def _voxel_size(summary: Mapping[str, Any]) -> str:
    size = dig(summary, "map.voxel_size_m")
    return "-" if size is None else voxel_size_text(size, summary.get("scale") != "unknown")


def _stage(times: Mapping[str, float | None]) -> str:
    return ", ".join("-" if ms is None else f"{ms:.2f}" for ms in times.values()) + " ms"


def _scene_known(scene: Mapping[str, Any]) -> str:
    """Pixels that weights of one scene know; those of another scene know few."""
    known, outside = percent(scene["known"]), scene["frames_outside"]
    return f"{known} of the pixels; {counted(outside, 'frame')} mostly unknown" if outside else f"{known} of the pixels"


def _pose_figure(check: Mapping[str, Any], key: str) -> str:
    """A figure of the pose check, or that too few keyframes overlap for it."""
    value = check.get(key)
    return "not checked" if value is None else percent(value)


def describe_depth(depth: Mapping[str, Any]) -> str:
    """Where depth comes from."""
    fractions = {"computed from the pictures": "computed_fraction", "rendered by the field": "rendered_fraction"}
    parts = [f"{how} for {percent(depth[key])}" for how, key in fractions.items() if depth.get(key)]
    return f"{', '.join(parts)} of the frames" if parts else "sensor"


_ROWS: Sequence[tuple[str, str, Callable[[Any], str]]] = (
    ("log", "source", str),
    ("weights", "weights.file", str),
    ("scale", "scale", str),
    ("depth", "depth", describe_depth),
    ("depth disagreement", "pose_check", lambda c: _pose_figure(c, "depth_disagreement")),
    ("contradicting pairs", "pose_check", lambda c: _pose_figure(c, "contradicting_pairs")),
    ("latency p50", "latency_ms.p50", _ms),
    ("latency p95", "latency_ms.p95", _ms),
    ("voxel size", "", _voxel_size),
    ("blocks", "map.blocks", str),
    ("surface points", "map", lambda m: f"{m['surface_points']}{' (nearly empty)' if m.get('nearly_empty') else ''}"),
    ("known to the weights", "scene", _scene_known),
    ("pictures unlike training", "pictures.unlike_training", percent),
    ("unknown surface", "map.unknown", percent),
    ("computed surface", "map.computed", percent),
    ("map memory", "map.memory_mb", lambda v: f"{v} MB"),
    ("mIoU", "metrics.miou", percent),
    ("total accuracy", "metrics.total_accuracy", percent),
    ("average accuracy", "metrics.average_accuracy", percent),
    ("mIoU a frame", "metrics_per_image.miou", percent),
    ("mIoU of the map", "metrics.map_miou", percent),
)
_ROWS_BY_NAME: Sequence[tuple[str, str, Callable[[Any], str]]] = (
    ("frames:", "frames", str),
    ("stage p50, p95:", "stages_ms", _stage),
    ("IoU", "metrics.per_class", percent),
)
