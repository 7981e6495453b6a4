"""What the benchmarks have found, as pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from research.bench.walk import SETTLED_MINUTE
from semantic_mapper.plots import Bar, Curve, Panel, draw_bars, draw_panels
from semantic_mapper.types import UInt8

GROWTH_LABELS = {
    "classes": "classes of the label set",
    "voxel_cm": "edge of a voxel, cm",
    "views": "source views a frame",
    "samples": "samples a ray, near the depth prior",
    "ray_share": "rays, fraction of the rendered view's pixels",
    "blocks": "blocks of the map before (8 x 8 x 8 voxels)",
}
_GROWTH_CURVES = {  # the step is drawn over its processor time: on an idle machine they are the same
    "cpu_ms": "processor time of a step",
    "step_ms": "step",
    "render_ms": "rendering",
    "fuse_ms": "fusion",
}
_WALK_PANELS = (
    (
        "time of a step",
        "ms",
        {"minute_step_p95_ms": "p95", "minute_step_p50_ms": "p50", "minute_fuse_p50_ms": "fusion"},
    ),
    ("resident memory", "MB", {"minute_rss_mb": "each minute"}),
    ("blocks of the map", "blocks", {"minute_blocks_on_disk": "on disk", "minute_blocks_in_memory": "in memory"}),
)
_SMALL_FRACTION = 0.01  # of a step; stages that take less stand under "rest"


def draw_growth(found: Sequence[Mapping[str, Any]], title: str) -> UInt8:
    """What ``bench_growth`` found, a panel for each setting, (H, W, 3) RGB."""
    return draw_panels(title, [_growth_panel(found, axis, label) for axis, label in GROWTH_LABELS.items()])


def _growth_panel(found: Sequence[Mapping[str, Any]], axis: str, label: str) -> Panel:
    runs = sorted((run for run in found if run["axis"] == axis), key=lambda run: run["value"])
    curves = [Curve(name, [(r["value"], r[key]) for r in runs], True) for key, name in _GROWTH_CURVES.items()]
    return Panel(label.partition(",")[0], "ms a frame (median)", label, curves if runs else ())


def draw_walk(found: Mapping[str, Any]) -> UInt8:
    """What ``bench_walk`` found against the minute of the walk, (H, W, 3) RGB."""
    title = f"{found['rooms']} rooms, {found['minutes']:g} minutes at {found['hz']:g} Hz, {found['size']}"
    curves = [[Curve(name, list(enumerate(found[key]))) for key, name in lines.items()] for _, _, lines in _WALK_PANELS]
    if found["rss_minute_5_mb"] is not None:  # else the walk was too short for these levels
        ends = SETTLED_MINUTE, len(found["minute_rss_mb"]) - 1
        levels = {"minute 5": found["rss_minute_5_mb"], "most after it": found["rss_max_after_minute_5_mb"]}
        curves[1] += [Curve(name, [(end, mb) for end in ends]) for name, mb in levels.items()]
    panels = zip(_WALK_PANELS, curves, strict=True)
    return draw_panels(title, [Panel(name, unit, "minute of the walk", lines) for (name, unit, _), lines in panels])


def draw_pipeline(found: Mapping[str, Mapping[str, Any]]) -> UInt8:
    """What ``bench_pipeline`` found, a bar for each quality by its name, (H, W, 3) RGB."""
    sizes = " and ".join(dict.fromkeys(figures["size"] for figures in found.values()))
    bars = [Bar(name, step_parts(figures)) for name, figures in found.items()]
    return draw_bars(f"a step at {sizes}, by stage", bars, "ms (medians)")


def step_parts(figures: Mapping[str, Any]) -> dict[str, float]:
    """Stages that matter, and the ``rest`` of the median step; ms. Medians of stages may add up to a little more."""
    step = figures["p50_ms"]
    parts = {name: float(ms) for name, ms in figures["stages_ms"].items() if ms >= _SMALL_FRACTION * step}
    rest = step - sum(parts.values())
    return {**parts, "rest": rest} if rest > 0 else parts
