"""The report of a replay or an evaluation as one page of HTML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from semantic_mapper.evaluation.plot import Bar, draw_bars
from semantic_mapper.evaluation.report import draw_strip

from semantic_mapper.nodes.cli.html_page import HtmlPage
from semantic_mapper.nodes.cli.summary_table import notes, summary_table
from semantic_mapper.replay.artifacts import MAX_LISTED, view_strips
from semantic_mapper.replay.summary import dig

if TYPE_CHECKING:
    from semantic_mapper.replay.session import MapSession

REPORT_NAME = "report.html"
STRIPS = 4  # frames that are shown


def write_replay_report(session: MapSession, summary: Mapping[str, Any], out: Path) -> None:
    """Write ``report.html`` to the folder of a replay, with what is there already.

    Raises:
        ConfigError: it cannot be written.
    """
    page = HtmlPage(f"Replay of {summary['source'] or 'a session'}")
    for note in notes(summary):
        page.text(note, note=True)
    page.picture_file(out / "overview.png", "Frames, what was rendered for them, and the map from above and aside")
    page.heading("Figures")
    page.table(summary_table({out.resolve().name: summary}))
    strips = view_strips(session, STRIPS)
    if strips:
        page.heading("Frames")
    for strip in strips:
        caption = f"{strip.name}: camera, rendered semantics, truth where there is one, depth"
        page.picture(draw_strip(strip, session.pipeline.label_set), caption, photo=True)
    _add_stages(page, {"this replay": summary})
    _add_classes(page, {"this replay": dig(summary, "metrics.per_class") or {}})
    _add_counts(page, summary)
    page.heading("Configuration")
    page.folded("Settings that were in force", json.dumps(summary["config"], indent=1))
    page.rows(("package", "version"), list(summary["versions"].items()))
    page.write(out / REPORT_NAME)


def write_eval_report(
    path: Path,
    summaries: Mapping[str, Mapping[str, Any]],
    folders: Sequence[Path],
    logs: Mapping[str, Table],
    found: Any,
) -> None:
    """Write the report of ``eval``.

    Args:
        path: Of the page.
        summaries: Of replays, by name; ``folders`` are theirs, in this order.
        logs: The table of each log that was scored.
        found: All figures, as in the JSON file.

    Raises:
        ConfigError: it cannot be written.
    """
    page = HtmlPage(f"Evaluation of {', '.join([*summaries, *(Path(log).name for log in logs)])}")
    if summaries:
        page.table(summary_table(summaries))
        _add_stages(page, summaries)
        _add_classes(page, {name: dig(s, "metrics.per_class") or {} for name, s in summaries.items()})
    for (name, summary), folder in zip(summaries.items(), folders, strict=True):
        page.heading(name)
        for note in notes(summary):
            page.text(note, note=True)
        page.picture_file(folder / "overview.png", f"{name}: frames and map")
        page.folded("Settings that were in force", json.dumps(summary.get("config"), indent=1))
    for log, table in logs.items():
        page.heading(Path(log).name)
        page.table(table)
        methods = found["logs"][log]["methods"]
        _add_classes(page, {name: m["per_class"] for name, m in methods.items()})
    if found.get("surface"):
        page.heading("Surface")
        rows = [
            (name, f"{f['median_m'] * 1000:.1f} mm", f"{f['complete'] * 100:.1f} %")
            for name, f in found["surface"].items()
        ]
        page.rows(("map", "median distance from the mesh", "of the mesh within 5 cm"), rows)
    page.folded("All figures", json.dumps(found, indent=1))
    page.write(path)


def write_suite_report(path: Path, table: Table, lines: Sequence[str], pictures: Sequence[Path], found: Any) -> None:
    """Write the report of a benchmark run with its pictures.

    Raises:
        ConfigError: it cannot be written.
    """
    page = HtmlPage(found["title"])
    page.table(table)
    for line in lines:
        page.text(line)
    for picture in pictures:
        page.picture_file(picture, picture.name)
    page.folded("All figures", json.dumps(found, indent=1))
    page.write(path)


def _add_stages(page: HtmlPage, summaries: Mapping[str, Mapping[str, Any]]) -> None:
    """Median and 95th percentile of each stage of a step, as bars and in figures."""
    stages = {name: s.get("stages_ms") or {} for name, s in summaries.items()}
    bars = [
        Bar(f"{name} {share}" if len(stages) > 1 else share, parts)
        for name, times in stages.items()
        for share in ("p50", "p95")
        if (parts := {stage: t[share] for stage, t in times.items() if t[share]})
    ]
    if not bars:
        return
    page.heading("Times of the stages of a step")
    page.picture(
        draw_bars("", bars, "ms; each stage by itself"), "Stages of a step, median and 95th percentile", photo=False
    )
    rows = [
        (
            *([name] if len(stages) > 1 else []),
            stage,
            *("-" if t[share] is None else f"{t[share]:.2f}" for share in ("p50", "p95")),
        )
        for name, times in stages.items()
        for stage, t in times.items()
    ]
    page.rows((*([""] if len(stages) > 1 else []), "stage", "p50, ms", "p95, ms"), rows)


def _add_classes(page: HtmlPage, methods: Mapping[str, Mapping[str, float | None]]) -> None:
    """IoU of each class, a bar for each method."""
    bars = [
        Bar(f"{name}: {method}" if len(methods) > 1 else name, {method: 100 * value})
        for name in dict.fromkeys(n for scores in methods.values() for n in scores)
        for method, scores in methods.items()
        if (value := scores.get(name)) is not None
    ]
    if bars:
        page.heading("Classes")
        page.picture(draw_bars("", bars, "IoU, %"), "IoU of each class", photo=False)


def _add_counts(page: HtmlPage, summary: Mapping[str, Any]) -> None:
    page.heading("Frames that came, and what became of them")
    page.rows(("frames", ""), [(name.replace("_", " "), str(count)) for name, count in summary["frames"].items()])
    if summary["refusals"]:
        page.text(f"Refused, the first {MAX_LISTED} of them:")
        page.rows(
            ("seq", "stamp, ns", "reason"),
            [(str(r["seq"]), str(r["stamp_ns"]), r["reason"]) for r in summary["refusals"]],
        )
    for stretch in summary["damaged_stretches"]:
        page.text(f"Damaged: {stretch}", note=True)
