"""Run the suite AERIAL from the command line: arms, their scores and the claims of IRT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.table import Table

from semantic_mapper import __version__
from semantic_mapper.benchmark.aerial import (
    AERIAL_TIERS,
    DAY,
    AerialConfig,
    Arm,
    aerial_table,
    episodes,
    run_aerial,
)
from semantic_mapper.benchmark.aerial import Table as Counted
from semantic_mapper.benchmark.aerial_arms import IMAGE_ARMS
from semantic_mapper.benchmark.aerial_claims import (
    BRIDGE_PAIR,
    CONSISTENCY,
    DARK_DROP,
    FROM_LOW,
    IN_THE_DARK,
    LOW_DROP,
    MIOU,
    ROOF_PAIR,
    AerialResult,
    check_aerial_claims,
    figure,
)
from semantic_mapper.benchmark.aerial_fields import field_arms
from semantic_mapper.benchmark.aerial_irt import irt_arms
from semantic_mapper.benchmark.store import RecordStore
from semantic_mapper.config import convert_config, load_config, to_plain
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.cli.outputs import prepare_file
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.artifacts import write_json
from semantic_mapper.scenes.suite import AERIAL_SUITE

_MEASURES = (MIOU, IN_THE_DARK, FROM_LOW, CONSISTENCY, DARK_DROP, LOW_DROP, BRIDGE_PAIR, ROOF_PAIR)


def aerial_config(path: Path | None, tier: str | None, seed: int | None) -> AerialConfig:
    """The run of a TOML file, else of the tier.

    Raises:
        ConfigError: a file that cannot be used.
        typer.BadParameter: no such tier, or a tier beside a file.
    """
    if tier is not None and tier not in AERIAL_TIERS:
        raise typer.BadParameter(f"aerial has the tiers {' and '.join(AERIAL_TIERS)}", param_hint="--tier")
    if tier is not None and path is not None:
        raise typer.BadParameter("aerial: the file says everything that a tier says", param_hint="--tier")
    config = load_config(path, AerialConfig) if path else AERIAL_TIERS["record" if tier == "record" else "cpu"]
    return config if seed is None else convert_config(to_plain(config) | {"seed": seed}, AerialConfig, "command line")


def aerial_arms(folder: Path) -> dict[str, Arm]:
    """All arms by name; fitted grids are kept in ``folder``."""
    return IMAGE_ARMS | field_arms(folder) | irt_arms(folder)


def run_aerial_verb(
    config: AerialConfig, names: Sequence[str], claims: bool, out: Path | None, *, print_json: bool
) -> int:
    """Run the arms that are missing, then print and write what there is; returns the exit code.

    Args:
        config: What to run.
        names: Of arms; none = all.
        claims: Print the table of claims.
        out: JSON; None = named after the suite. Beside it lie the records (``.jsonl``)
            and fitted grids (``aerial-grids``).
        print_json: Print JSON, and nothing else.

    Raises:
        ConfigError: with what is wrong and the mend.
    """
    out = out or Path("runs") / f"aerial-{config.width}.json"
    every = aerial_arms(out.parent / "aerial-grids")
    if unknown := sorted(set(names) - every.keys()):
        raise typer.BadParameter(f"no arm {', '.join(unknown)}; there are {', '.join(every)}", param_hint="--arm")
    output = Output.guarded()
    output.quiet = print_json
    keep_freed_memory()
    prepare_file(out)
    store, arms = RecordStore(out.with_suffix(".jsonl")), {name: every[name] for name in names or every}
    with StopRequest() as stop:
        with frame_progress("benchmark aerial", None, unit="episodes") as bar:
            all_episodes = episodes(config)
            bar.start(len(arms) * len(all_episodes))
            for name, episode in run_aerial(config, arms, store, lambda: stop):
                done = list(arms).index(name) * len(all_episodes) + all_episodes.index(episode)
                bar.set(done, f"{name}, town {episode.town}, labels {episode.choice}")
        table = aerial_table(config, list(every), store)
        found = _collect(config, list(every), table)
        results = check_aerial_claims(table, seed=config.seed)
        found["claims"] = [_plain(result) for result in results]
        write_json(out, found)
        output.print(_arms_table(found))
        if claims:
            output.print(_claims_table(results))
        output.print(f"written to {out}")
        if print_json:
            output.json(found)
        if stop:
            stderr_console().print(f"stopped by {stop.name}; the same command goes on from here", style="yellow")
        return stop.exit_code


def _collect(config: AerialConfig, names: Sequence[str], table: Counted) -> dict[str, Any]:
    size = f"{config.towns} towns, {config.choices} choices of {config.labelled} labelled views"
    found: dict[str, Any] = {"title": f"AERIAL {config.width}x{config.width}, {size}", "config": to_plain(config)}
    found["arms"] = {}
    for name in names:
        figures = {m.name: value for m in _MEASURES if (value := figure(table, name, m)) is not None}
        if not figures:
            continue
        row: dict[str, Any] = {"figures": figures}
        if counts := table.get((name, DAY)):
            matrix = ConfusionMatrix(AERIAL_SUITE.label_set)
            matrix.counts = np.sum(list(counts.values()), axis=0)
            row |= asdict(matrix.metrics())
        found["arms"][name] = row
    found["versions"] = {"semantic_mapper": __version__}
    return found


def _plain(result: AerialResult) -> dict[str, Any]:
    claim = result.claim
    return {
        "claim": claim.name,
        "paper": claim.paper,
        "measure": claim.measure.name,
        "accepted_if": claim.accepted_if,
        "difference": result.difference,
        "low": result.low,
        "high": result.high,
        "views": result.views,
        "result": result.result,
    }


def _arms_table(found: Mapping[str, Any]) -> Table:
    table = Table(title=found["title"], title_justify="left")
    table.add_column("")
    arms = found["arms"]
    for name in arms:
        table.add_column(name, justify="right")
    for measure in _MEASURES:
        row = [arm["figures"].get(measure.name) for arm in arms.values()]
        if any(value is not None for value in row):
            table.add_row(measure.name, *("-" if value is None else f"{value:.1f}" for value in row))
    table.add_section()
    for name in AERIAL_SUITE.label_set.names:
        classes = [(arm.get("per_class") or {}).get(name) for arm in arms.values()]
        if any(value is not None for value in classes):
            table.add_row(f"IoU {name}", *("-" if value is None else f"{100 * value:.1f}" for value in classes))
    return table


def _claims_table(results: Sequence[AerialResult]) -> Table:
    table = Table(title="claims of IRT, points", title_justify="left")
    for column in ("claim", "paper", "measure", "accepted if", "difference", "95 % interval", "result"):
        table.add_column(column)
    for result in results:
        claim = result.claim
        measured = ("-", "-")
        if result.difference is not None:
            measured = f"{result.difference:+.1f}", f"{result.low:+.1f} to {result.high:+.1f}"
        table.add_row(claim.name, claim.paper or "-", claim.measure.name, claim.accepted_if, *measured, result.result)
    return table
