"""Scores of a log as a table, and with those of replays as a page of HTML."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from semantic_mapper.replay.page import Section, picture_files, table_of, write_page
from semantic_mapper.replay.summary import figures_table, notes, percent, summary_table


def write_eval_report(path: Path, found: Mapping[str, Any], folders: Sequence[Path] = ()) -> None:
    """Write the report of ``eval`` with all figures, as in the JSON file. ConfigError where it cannot be written.

    ``folders`` are those of the replays, in order.
    """
    summaries, logs = found["replays"], found["logs"]
    sections = [Section(tables=[summary_table(summaries)])] if summaries else []
    for (name, summary), folder in zip(summaries.items(), folders, strict=True):
        pictures = list(picture_files((folder / "overview.png", f"{name}: frames and map")))
        settings = {"Settings that were in force": json.dumps(summary.get("config"), indent=1)}
        sections.append(Section(name, notes(summary), pictures=pictures, folded=settings))
    sections += [Section(Path(log).name, tables=[score_table(Path(log).name, of)]) for log, of in logs.items()]
    if found.get("surface"):
        rows = [
            (name, f"{f['median_m'] * 1000:.1f} mm", percent(f["complete"]), percent(f["complete_10cm"]))
            for name, f in found["surface"].items()
        ]
        heads = ("map", "median distance from the mesh", "of the mesh within 5 cm", "within 10 cm")
        sections.append(Section("Surface", tables=[table_of(heads, rows)]))
    sections.append(Section(folded={"All figures": json.dumps(found, indent=1)}))
    write_page(path, f"Evaluation of {', '.join([*summaries, *(Path(log).name for log in logs)])}", sections)


def score_table(title: str, scores: Mapping[str, Any]) -> Table:
    """One column a method."""
    counts = f"{scores['scored']} frames scored, {scores['excluded']} left out as keyframes"
    if scores["pseudo_labelled"]:
        counts += f", {scores['pseudo_labelled']} with pseudo labels"
    return figures_table(f"{title}: {counts}", scores["methods"], _ROWS, _ROWS_BY_NAME)


_ROWS = [
    (text, key, percent)
    for key, text in {
        "miou": "mIoU",
        "total_accuracy": "total accuracy",
        "average_accuracy": "average accuracy",
        "coverage": "coverage",
        "ece": "calibration error",
        "sure": "confidence above 0.9",
        "sure_right": "of these right",
        "pq": "PQ",
        "sq": "SQ",
        "rq": "RQ",
        "pq_plus": "PQ+",
        "pq_things": "PQ of things",
        "open_set_auroc": "AUROC, classes it lacks",
        "open_set_unknown": "unknown, of classes it lacks",
    }.items()
]
_ROWS_BY_NAME = (("IoU", "per_class", percent), ("PQ", "pq_per_class", lambda quality: percent(quality["pq"])))
