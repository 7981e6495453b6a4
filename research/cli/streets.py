"""The suite STREETS for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from research.cli.arm_suite import ArmSuite, tier_config
from research.evaluation.street_map import map_arm
from research.scenes.suite import STREETS_SUITE
from research.suites.claims import CountTable, Training
from research.suites.store import RecordStore
from research.suites.streets import (
    ARMS,
    CLAIMS,
    LABELS,
    MEASURES,
    STREETS_TIERS,
    Arm,
    StreetsConfig,
    run_streets,
    street_seeds,
    streets_table,
)
from research.suites.streets_panoptic import panoptic_arms
from semantic_mapper.config import to_plain


def streets_suite(path: Path | None, tier: str | None, seed: int | None) -> ArmSuite[Arm]:
    """The suite as a TOML file or a tier has it; raises as ``tier_config``."""
    config = tier_config("streets", path, tier, seed, STREETS_TIERS)

    def scores(names: Sequence[str], store: RecordStore) -> tuple[CountTable, Training]:
        return streets_table(config, names, store), Training()

    return ArmSuite(
        name="streets",
        title=f"STREETS, {config.streets} streets of {config.pairs} pairs, {config.width} pixels wide",
        paper="Panoptic NeRF",
        file=f"streets-{config.width}",
        config=to_plain(config),
        label_set=STREETS_SUITE.label_set,
        arms=lambda folder: ARMS | {"map": map_arm} | panoptic_arms(folder, moving=config.moving),
        units=config.streets,
        run=lambda arms, store, stopped: _run(config, arms, store, stopped),
        scores=scores,
        measures=MEASURES,
        class_kinds=(LABELS,),
        claims=CLAIMS,
        seed=config.seed,
    )


def _run(
    config: StreetsConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object]
) -> Iterator[tuple[int, str]]:
    seeds = street_seeds(config)
    for name, seed in run_streets(config, arms, store, stopped):
        yield seeds.index(seed) * len(arms) + list(arms).index(name), f"{name}, street {seed}"
