"""Run a suite of arms from the command line: their figures, and the claims of a paper judged by them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import typer
from rich.table import Table

from research.suites.claims import Claim, ClaimResult, CountTable, Measure, Training, check_claims, figure
from research.suites.store import RecordStore
from semantic_mapper import __version__
from semantic_mapper.config import Config, convert_config, load_config, to_plain
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.files import write_json
from semantic_mapper.labels import LabelSet
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.run_folder import prepare_file

ArmT = TypeVar("ArmT")
ConfigT = TypeVar("ConfigT", bound=Config)
Tier = Literal["cpu", "record"]


@dataclass(frozen=True, slots=True)
class ArmSuite(Generic[ArmT]):
    """A suite of arms.

    Args:
        name: By which the command line knows it.
        title: Over the table of arms.
        paper: Whose claims are judged.
        file: Name of the results' file, without its ending.
        config: Plain data, written with the results.
        label_set: Classes.
        arms: By name; what they fit is kept in the folder.
        units: Records an arm makes.
        run: Makes the records of these arms that are missing; yields how many units are done, and what is next.
        scores: Counts of the records that there are of these arms, and how their arms were trained.
        measures: Rows of the table.
        class_kinds: What is shown by class.
        claims: To judge.
        seed: Of their bootstrap.
    """

    name: str
    title: str
    paper: str
    file: str
    config: Mapping[str, Any]
    label_set: LabelSet
    arms: Callable[[Path], Mapping[str, ArmT]]
    units: int
    run: Callable[[Mapping[str, ArmT], RecordStore, Callable[[], object]], Iterator[tuple[int, str]]]
    scores: Callable[[Sequence[str], RecordStore], tuple[CountTable, Training]]
    measures: Sequence[Measure]
    class_kinds: Sequence[str]
    claims: Sequence[Claim]
    seed: int


def tier_config(
    suite: str, path: Path | None, tier: str | None, seed: int | None, tiers: Mapping[Tier, ConfigT]
) -> ConfigT:
    """The run of a TOML file, else of the tier.

    Raises:
        ConfigError: a file that cannot be used.
        typer.BadParameter: no such tier, or a tier beside a file.
    """
    if tier is not None and tier not in tiers:
        raise typer.BadParameter(f"{suite} has the tiers {' and '.join(tiers)}", param_hint="--tier")
    if tier is not None and path is not None:
        raise typer.BadParameter(f"{suite}: the file says everything that a tier says", param_hint="--tier")
    config = tiers["record" if tier == "record" else "cpu"]
    config = load_config(path, type(config)) if path else config
    return config if seed is None else convert_config(to_plain(config) | {"seed": seed}, type(config), "command line")


def run_arm_suite(
    suite: ArmSuite[ArmT], names: Sequence[str], claims: bool, out: Path | None, *, print_json: bool
) -> int:
    """Run the arms that are missing, then print and write what there is; returns the exit code.

    Raises ConfigError: with what is wrong and the mend.

    Args:
        suite: What to run.
        names: Of arms; none = all.
        claims: Print the table of claims.
        out: JSON; None = named after the suite. Beside it lie the records (``.jsonl``), and what arms fit
            (folder ``SUITE-grids``).
        print_json: Print JSON, and nothing else.
    """
    out = out or Path("runs") / f"{suite.file}.json"
    every = suite.arms(out.parent / f"{suite.name}-grids")
    if unknown := sorted(set(names) - every.keys()):
        raise typer.BadParameter(f"no arm {', '.join(unknown)}; there are {', '.join(every)}", param_hint="--arm")
    output = Output.guarded()
    output.quiet = print_json
    keep_freed_memory()
    prepare_file(out)
    store, arms = RecordStore(out.with_suffix(".jsonl")), {name: every[name] for name in names or every}
    with StopRequest() as stop:
        with frame_progress(f"benchmark {suite.name}", None, unit="units") as bar:
            bar.start(len(arms) * suite.units)
            for done, text in suite.run(arms, store, lambda: stop):
                bar.set(done, text)
        table, training = suite.scores(list(every), store)
        results = check_claims(suite.claims, table, training=training, seed=suite.seed)
        found: dict[str, Any] = {"title": suite.title, "config": suite.config}
        found["arms"] = {n: row for n in every if (row := _figures(suite, n, table))["figures"]}
        found["claims"] = [_plain(result) for result in results]
        found["versions"] = {"semantic_mapper": __version__}
        write_json(out, found)
        output.print(_arms_table(suite, found["arms"]))
        if claims:
            output.print(_claims_table(suite.paper, results))
        output.print(f"written to {out}")
        if print_json:
            output.json(found)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the same command goes on from here", style="yellow")
        return stop.exit_code


def _figures(suite: ArmSuite[Any], arm: str, table: CountTable) -> dict[str, Any]:
    """Figures of an arm in points by measure, and IoU of classes in 0..1 by what is scored."""
    figures = {m.name: value for m in suite.measures if (value := figure(table, arm, m)) is not None}
    classes: dict[str, dict[str, float]] = {}
    for kind in suite.class_kinds:
        if counts := table.get((arm, kind)):
            matrix = ConfusionMatrix(suite.label_set)
            matrix.counts = np.sum(list(counts.values()), axis=0)
            classes[kind] = matrix.metrics().per_class
    return {"figures": figures, "per_class": classes}


def _plain(result: ClaimResult) -> dict[str, Any]:
    claim = result.claim
    return {
        "claim": claim.name,
        "paper": claim.paper,
        "measure": claim.measure.name,
        "accepted_if": claim.accepted_if,
        "difference": result.difference,
        "low": result.low,
        "high": result.high,
        "units": result.units,
        "result": result.result,
        "reason": result.reason,
    }


def _arms_table(suite: ArmSuite[Any], arms: Mapping[str, Any]) -> Table:
    table = Table(title=suite.title, title_justify="left")
    table.add_column("")
    for name in arms:
        table.add_column(name, justify="right")
    for measure in suite.measures:
        _add_row(table, measure.name, [arm["figures"].get(measure.name) for arm in arms.values()])
    for kind in suite.class_kinds:
        table.add_section()
        suffix = f", {kind}" if len(suite.class_kinds) > 1 else ""
        for name in suite.label_set.names:
            classes = [arm["per_class"].get(kind, {}).get(name) for arm in arms.values()]
            _add_row(table, f"IoU {name}{suffix}", [None if x is None else 100 * x for x in classes])
    return table


def _add_row(table: Table, name: str, row: Sequence[float | None]) -> None:
    if any(value is not None for value in row):
        table.add_row(name, *("-" if value is None else f"{value:.1f}" for value in row))


def _claims_table(paper: str, results: Sequence[ClaimResult]) -> Table:
    table = Table(title=f"claims of {paper}, points", title_justify="left")
    for column in ("claim", "paper", "measure", "accepted if", "difference", "95 % interval", "result"):
        table.add_column(column)
    for result in results:
        claim = result.claim
        measured = ("-", "-")
        if result.difference is not None:
            measured = f"{result.difference:+.1f}", f"{result.low:+.1f} to {result.high:+.1f}"
        why = f": {result.reason}" if result.reason else ""
        row = (claim.name, claim.paper or "-", claim.measure.name, claim.accepted_if, *measured, result.result + why)
        table.add_row(*row)
    return table
