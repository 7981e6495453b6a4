"""Scores of a log as a table, and with those of replays as a page of HTML."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from semantic_mapper.replay.page import Section, picture_files, stage_sections, table_of, write_page
from semantic_mapper.replay.summary import notes, percent, summary_table


def write_eval_report(
    path: Path,
    summaries: Mapping[str, Mapping[str, Any]],
    folders: Sequence[Path],
    logs: Mapping[str, Table],
    found: Any,
) -> None:
    """Write the report of ``eval``.

    ``folders`` are those of the ``summaries`` of replays, in order; ``logs`` has the table of each log that was scored,
    ``found`` all figures, as in the JSON file. ConfigError where it cannot be written.
    """
    sections: list[Section] = []
    if summaries:
        sections += [Section(tables=[summary_table(summaries)]), *stage_sections(summaries)]
    for (name, summary), folder in zip(summaries.items(), folders, strict=True):
        pictures = list(picture_files((folder / "overview.png", f"{name}: frames and map")))
        settings = {"Settings that were in force": json.dumps(summary.get("config"), indent=1)}
        sections.append(Section(name, notes(summary), pictures=pictures, folded=settings))
    for log, table in logs.items():
        sections.append(Section(Path(log).name, tables=[table]))
    if found.get("surface"):
        rows = [
            (
                name,
                f"{f['median_m'] * 1000:.1f} mm",
                f"{f['complete'] * 100:.1f} %",
                f"{f['complete_10cm'] * 100:.1f} %",
            )
            for name, f in found["surface"].items()
        ]
        heads = ("map", "median distance from the mesh", "of the mesh within 5 cm", "within 10 cm")
        sections.append(Section("Surface", tables=[table_of(heads, rows)]))
    sections.append(Section(folded={"All figures": json.dumps(found, indent=1)}))
    write_page(path, f"Evaluation of {', '.join([*summaries, *(Path(log).name for log in logs)])}", sections)


def score_table(title: str, scores: Mapping[str, Any]) -> Table:
    """One column a method."""
    methods: Mapping[str, Mapping[str, Any]] = scores["methods"]
    counts = f"{scores['scored']} frames scored, {scores['excluded']} left out as keyframes"
    if scores["pseudo_labelled"]:
        counts += f", {scores['pseudo_labelled']} with pseudo labels"
    table = Table(title=f"{title}: {counts}", title_justify="left")
    table.add_column("")
    for name in methods:
        table.add_column(name, justify="right")
    for key, text in (
        ("miou", "mIoU"),
        ("total_accuracy", "total accuracy"),
        ("average_accuracy", "average accuracy"),
        ("coverage", "coverage"),
        ("ece", "calibration error"),
        ("sure", "confidence above 0.9"),
        ("sure_right", "of these right"),
        ("pq", "PQ"),
        ("sq", "SQ"),
        ("rq", "RQ"),
        ("pq_plus", "PQ+"),
        ("pq_things", "PQ of things"),
        ("open_set_auroc", "AUROC, classes it lacks"),
        ("open_set_unknown", "unknown, of classes it lacks"),
    ):
        if any(m.get(key) is not None for m in methods.values()):
            table.add_row(text, *(_show(m.get(key)) for m in methods.values()))
    table.add_section()
    for name in dict.fromkeys(n for m in methods.values() for n in m["per_class"]):
        table.add_row(f"IoU {name}", *(_show(m["per_class"].get(name)) for m in methods.values()))
    table.add_section()
    of_things = [m.get("pq_per_class", {}) for m in methods.values()]
    for name in dict.fromkeys(n for classes in of_things for n in classes):
        table.add_row(f"PQ {name}", *(_show(c[name]["pq"] if name in c else None) for c in of_things))
    return table


def _show(value: float | None) -> str:
    return "-" if value is None else percent(value)
