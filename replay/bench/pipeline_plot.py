"""The stages of a step as one picture, a bar for each quality."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semantic_mapper.evaluation.plot import Bar, draw_bars
from semantic_mapper.evaluation.sheet import write_picture

LEAST_SHARE = 0.01  # of a step; stages that take less stand under "rest"


def write_pipeline_plot(found: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw what ``bench_pipeline`` found, by name of the quality, into a PNG, whole or not at all."""
    bars = [Bar(name, step_parts(figures)) for name, figures in found.items()]
    sizes = " and ".join(dict.fromkeys(figures["size"] for figures in found.values()))
    write_picture(path, draw_bars(f"a step at {sizes}, by stage", bars, "milliseconds (medians)"))


def step_parts(figures: Mapping[str, Any]) -> dict[str, float]:
    """Stages that matter, and the ``rest`` of the median step; ms. Medians of stages may add up to a little more."""
    step = figures["p50_ms"]
    parts = {name: float(ms) for name, ms in figures["stages_ms"].items() if ms >= LEAST_SHARE * step}
    rest = step - sum(parts.values())
    return {**parts, "rest": rest} if rest > 0 else parts
