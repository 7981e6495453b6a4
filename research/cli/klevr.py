"""The suite KLEVR for the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from research.cli.arm_suite import ArmSuite, tier_config
from research.scenes.suite import KLEVR_SUITE
from research.suites.klevr import (
    KLEVR_SEEDS,
    KLEVR_TIERS,
    POINTS,
    TRAIN_CAMERAS,
    Arm,
    KlevrConfig,
    klevr_scores,
    novel_seeds,
    run_klevr,
)
from research.suites.klevr_claims import CLAIMS, MEASURES
from research.suites.klevr_images import image_arms
from research.suites.klevr_nesf import nesf_arms
from research.suites.store import RecordStore
from semantic_mapper.config import to_plain


def klevr_suite(path: Path | None, tier: str | None, seed: int | None) -> ArmSuite[Arm]:
    """The suite as a TOML file or a tier has it, one run a seed; raises as ``tier_config``."""
    first = tier_config("klevr", path, tier, seed, KLEVR_TIERS)
    count = KLEVR_SEEDS["record" if tier == "record" else "cpu"]
    configs = [msgspec.structs.replace(first, seed=first.seed + k) for k in range(count)]
    size = f"{len(novel_seeds(first))} novel scenes, {first.width}x{first.width}, seeds {[c.seed for c in configs]}"
    return ArmSuite(
        name="klevr",
        title=f"KLEVR {first.variant}, {size}",
        paper="NeSF",
        file=f"klevr-{first.variant}-{first.width}",
        config=to_plain(first),
        label_set=KLEVR_SUITE.label_set,
        arms=lambda folder: image_arms(folder) | nesf_arms(folder),
        units=len(configs),
        run=lambda arms, store, stopped: _run(configs, arms, store, stopped),
        scores=lambda names, store: klevr_scores(configs, names, store),
        measures=MEASURES,
        class_kinds=(TRAIN_CAMERAS, POINTS),
        claims=CLAIMS,
        seed=first.seed,
    )


def _run(
    configs: Sequence[KlevrConfig], arms: Mapping[str, Arm], store: RecordStore, stopped: Callable[[], object]
) -> Iterator[tuple[int, str]]:
    for done, config in enumerate(configs):
        for name in run_klevr(config, arms, store, stopped):
            yield done * len(arms) + list(arms).index(name), f"{name}, seed {config.seed}"
