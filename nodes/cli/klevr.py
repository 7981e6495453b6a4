"""Run the suite KLEVR from the command line: arms, their scores and the claims of NeSF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import typer
from rich.table import Table

from semantic_mapper import __version__
from semantic_mapper.benchmark.claims import ClaimResult, Scores, check_claims
from semantic_mapper.benchmark.klevr import (
    ARMS,
    CLAIMS,
    KLEVR_SEEDS,
    KLEVR_TIERS,
    KlevrConfig,
    klevr_scores,
    novel_seeds,
    run_klevr,
)
from semantic_mapper.benchmark.klevr_nesf import nesf_arms
from semantic_mapper.benchmark.store import RecordStore
from semantic_mapper.config import convert_config, load_config, to_plain
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.memory import keep_freed_memory
from semantic_mapper.nodes.cli.console import Output, frame_progress, stderr_console
from semantic_mapper.nodes.cli.outputs import prepare_file
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.artifacts import write_json
from semantic_mapper.scenes.suite import KLEVR_SUITE


def klevr_configs(path: Path | None, tier: str | None, seed: int | None) -> list[KlevrConfig]:
    """One run a seed: of a TOML file, else of the tier.

    Raises:
        ConfigError: a file that cannot be used.
        typer.BadParameter: no such tier, or a tier beside a file.
    """
    if tier is not None and tier not in KLEVR_TIERS:
        raise typer.BadParameter(f"klevr has the tiers {' and '.join(KLEVR_TIERS)}", param_hint="--tier")
    if tier is not None and path is not None:
        raise typer.BadParameter("klevr: the file says everything that a tier says", param_hint="--tier")
    config = load_config(path, KlevrConfig) if path else KLEVR_TIERS["record" if tier == "record" else "cpu"]
    if seed is not None:
        config = convert_config(to_plain(config) | {"seed": seed}, KlevrConfig, "command line")
    count = KLEVR_SEEDS["record" if tier == "record" else "cpu"]
    return [msgspec.structs.replace(config, seed=config.seed + k) for k in range(count)]


def run_klevr_verb(
    configs: Sequence[KlevrConfig], names: Sequence[str], claims: bool, out: Path | None, *, print_json: bool
) -> int:
    """Run the arms that are missing, then print and write what there is; returns the exit code.

    Args:
        configs: One a seed, otherwise the same.
        names: Of arms; none = all.
        claims: Print the table of claims.
        out: JSON; None = named after the suite. Beside it lie the records (``.jsonl``)
            and fitted densities (``klevr-grids``).
        print_json: Print JSON, and nothing else.

    Raises:
        ConfigError: with what is wrong and the mend.
    """
    out = out or Path("runs") / f"klevr-{configs[0].variant}-{configs[0].width}.json"
    every = ARMS | nesf_arms(out.parent / "klevr-grids")
    if unknown := sorted(set(names) - every.keys()):
        raise typer.BadParameter(f"no arm {', '.join(unknown)}; there are {', '.join(every)}", param_hint="--arm")
    output = Output.guarded()
    output.quiet = print_json
    keep_freed_memory()
    prepare_file(out)
    store, arms = RecordStore(out.with_suffix(".jsonl")), {name: every[name] for name in names or every}
    with StopRequest() as stop:
        with frame_progress("benchmark klevr", None, unit="arms") as bar:
            bar.start(len(arms) * len(configs))
            for done, config in enumerate(configs):
                for name in run_klevr(config, arms, store, lambda: stop):
                    bar.set(done * len(arms) + list(arms).index(name), f"{name}, seed {config.seed}")
        found, scores = _collect(configs, store)
        results = check_claims(CLAIMS, scores, seed=configs[0].seed)
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


def _collect(configs: Sequence[KlevrConfig], store: RecordStore) -> tuple[dict[str, Any], Scores]:
    scores = klevr_scores(configs, store)
    first = configs[0]
    size = f"{len(novel_seeds(first))} novel scenes, {first.width}x{first.width}, seeds {[c.seed for c in configs]}"
    found: dict[str, Any] = {"title": f"KLEVR {first.variant}, {size}", "config": to_plain(first), "arms": {}}
    for (arm, kind), by_scene in scores.items():
        metrics = sum(by_scene.values(), ConfusionMatrix(KLEVR_SUITE.label_set)).metrics()
        part = metrics.per_class.get("background", 0.0) / max(len(metrics.per_class), 1)
        row = asdict(metrics) | {"background_part": part, "scenes": len(by_scene)}
        found["arms"].setdefault(arm, {})[kind] = row
    found["versions"] = {"semantic_mapper": __version__}
    return found, scores


def _plain(result: ClaimResult) -> dict[str, Any]:
    claim = result.claim
    return {
        "claim": claim.name,
        "paper": claim.paper,
        "accepted_if": claim.accepted_if,
        "difference": result.difference,
        "low": result.low,
        "high": result.high,
        "scenes": result.scenes,
        "result": result.result,
    }


def _arms_table(found: Mapping[str, Any]) -> Table:
    classes = KLEVR_SUITE.label_set.names
    table = Table(title=found["title"], title_justify="left")
    table.add_column("arm")
    table.add_column("scored")
    for column in ("mIoU", "of it background", *classes):
        table.add_column(column, justify="right")
    for arm, kinds in found["arms"].items():
        for kind, row in kinds.items():
            figures = (row["miou"], row["background_part"], *(row["per_class"].get(name) for name in classes))
            table.add_row(arm, kind, *("-" if x is None else f"{100 * x:.1f}" for x in figures))
    return table


def _claims_table(results: Sequence[ClaimResult]) -> Table:
    table = Table(title="claims of NeSF, points of mIoU", title_justify="left")
    for column in ("claim", "paper", "accepted if", "difference", "95 % interval", "result"):
        table.add_column(column)
    for result in results:
        claim = result.claim
        measured = ("-", "-")
        if result.difference is not None:
            measured = f"{result.difference:+.1f}", f"{result.low:+.1f} to {result.high:+.1f}"
        table.add_row(claim.name, claim.paper or "-", claim.accepted_if, *measured, result.result)
    return table
