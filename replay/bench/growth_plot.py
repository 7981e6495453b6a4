"""What a step takes as one setting grows, as one picture with a panel for each setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from semantic_mapper.evaluation.plot import Curve, Panel, draw_panels
from semantic_mapper.evaluation.sheet import write_picture

AXIS_TITLES = {
    "classes": "classes of the label set",
    "voxel_cm": "edge of a voxel, cm",
    "views": "source views a frame",
    "samples": "samples a ray, near the depth prior",
    "ray_share": "rays, share of the rendered view's pixels",
    "blocks": "blocks of the map before (8 x 8 x 8 voxels)",
}
CURVES = {
    "cpu_ms": "processor time of a step",
    "step_ms": "step",  # drawn over it: on a machine that does nothing else they are the same
    "render_ms": "rendering",
    "fuse_ms": "fusion",
}


def write_growth_plot(found: Sequence[Mapping[str, Any]], path: Path, title: str) -> None:
    """Draw what ``bench_growth`` found into a PNG, whole or not at all."""
    panels = [_panel(x_title, [run for run in found if run["axis"] == axis]) for axis, x_title in AXIS_TITLES.items()]
    write_picture(path, draw_panels(title, panels))


def _panel(x_title: str, runs: Sequence[Mapping[str, Any]]) -> Panel:
    ascending = sorted(runs, key=lambda run: run["value"])
    curves = (
        Curve(name, tuple((float(run["value"]), float(run[key])) for run in ascending), marked=True)
        for key, name in CURVES.items()
    )
    return Panel("milliseconds a frame (median)", tuple(curves) if runs else (), x_title)
