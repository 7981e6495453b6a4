"""The suite AERIAL for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from research.cli.arm_suite import ArmSuite, tier_config
from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    AERIAL_TIERS,
    DAY,
    AerialConfig,
    Arm,
    aerial_table,
    episodes,
    run_aerial,
)
from research.suites.aerial_arms import IMAGE_ARMS
from research.suites.aerial_claims import CLAIMS, MEASURES
from research.suites.aerial_fields import field_arms
from research.suites.aerial_irt import irt_arms
from research.suites.claims import CountTable, Training
from research.suites.store import RecordStore
from semantic_mapper.config import to_plain


def aerial_suite(path: Path | None, tier: str | None, seed: int | None) -> ArmSuite[Arm]:
    """The suite as a TOML file or a tier has it; raises as ``tier_config``."""
    config = tier_config("aerial", path, tier, seed, AERIAL_TIERS)
    size = f"{config.towns} towns, {config.choices} choices of {config.labelled} labelled views"

    def scores(names: Sequence[str], store: RecordStore) -> tuple[CountTable, Training]:
        return aerial_table(config, names, store), Training()

    return ArmSuite(
        name="aerial",
        title=f"AERIAL {config.width}x{config.width}, {size}",
        paper="IRT",
        file=f"aerial-{config.width}",
        config=to_plain(config),
        label_set=AERIAL_SUITE.label_set,
        arms=lambda folder: IMAGE_ARMS | field_arms(folder) | irt_arms(folder),
        units=len(episodes(config)),
        run=lambda arms, store, stopped: _run(config, arms, store, stopped),
        scores=scores,
        measures=MEASURES,
        class_kinds=(DAY,),
        claims=CLAIMS,
        seed=config.seed,
    )


def _run(
    config: AerialConfig, arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object]
) -> Iterator[tuple[int, str]]:
    every = episodes(config)
    for name, episode in run_aerial(config, arms, store, stopped):
        done = list(arms).index(name) * len(every) + every.index(episode)
        yield done, f"{name}, town {episode.town}, labels {episode.choice}"
