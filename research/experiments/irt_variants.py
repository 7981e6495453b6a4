"""Variants of IRT on one fit of geometry and colours a room: mIoU of query views, with their image and without it.

python -m research.experiments.irt_variants --rooms 100000 100002 --keyframes 4 B BC RTTC
"""

from __future__ import annotations

import argparse
import time

import msgspec
import numpy as np
import torch

from research.suites.config import SceneBudget, SuiteConfig
from research.suites.predict import predict_view
from research.suites.protocols import choose_fitted
from research.suites.rooms import BenchmarkRoom, as_given, make_benchmark_room
from semantic_mapper.config import IRTConfig
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.fields.irt import IRT
from semantic_mapper.training.finetune import FinetuneConfig
from semantic_mapper.training.grid_fit import GridFit, GridFitConfig, fit_grid
from semantic_mapper.training.irt import ClassFit, labelled_rays
from semantic_mapper.training.scene_fit import fit_trunk
from semantic_mapper.types import PosedFrame

WIDTH, FRAMES = 160, 40


def fitted_grid(room: BenchmarkRoom, suite: SuiteConfig, steps: int) -> tuple[GridFit, IRT, list[PosedFrame]]:
    """Geometry, colours and features of all frames; and the labelled frames."""
    chosen = choose_fitted(room, suite)
    labelled = [as_given(room.given[n], depth=True, label=True) for n in chosen.labelled]
    frames = labelled + [as_given(room.given[n], depth=True) for n in chosen.unlabelled]
    config = GridFitConfig(steps=steps, trunk_steps=steps, width=WIDTH, held_out=0)
    fit = fit_grid(frames, config)
    torch.manual_seed(0)
    field = IRT(IRTConfig(grid=fit.grid.config), room.label_set)
    field.grid.load_state_dict(fit.grid.state_dict())
    field.fitted_steps += fit.steps
    assert field.trunk is not None
    fit_trunk(field, field.trunk, fit, config)
    return fit, field, labelled


def with_classes(base: IRT, labelled: list[PosedFrame], variant: str, steps: int, *, carry: bool) -> IRT:
    """A variant that stands on the same grid and features."""
    data = labelled_rays(labelled, base.label_set, FinetuneConfig(seconds=0, steps=steps, width=WIDTH))
    count = len(labelled) if carry else 0
    shape = msgspec.structs.replace(base.shape, variant=variant, carried=count, carried_size=data.rays.image_size(0))
    torch.manual_seed(0)
    field = IRT(shape, base.label_set)
    field.load_state_dict(
        {n: t for n, t in base.state_dict().items() if n.startswith(("grid.", "trunk.", "fitted"))}, strict=False
    )
    ClassFit(field, data, FinetuneConfig(seconds=0, steps=steps, width=WIDTH)).run(time.monotonic(), None, bool)
    return field.eval()


def score(room: BenchmarkRoom, field: IRT, suite: SuiteConfig, *, own_image: bool) -> ConfusionMatrix:
    """All query views."""
    total = ConfusionMatrix(room.label_set)
    for query in room.queries:
        asked = room.asked(query)
        other = as_given(room.given[0], depth=True)
        found = predict_view(field, [other, asked] if own_image else [other], asked, suite.tier, room.label_set)
        total.update(room.truth[query].label, found.label)
    return total


def main() -> None:
    """Print a table row a variant."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--rooms", nargs="+", type=int, default=[100000, 100002])
    parser.add_argument("--keyframes", type=int, default=4)
    parser.add_argument("--grid-steps", type=int, default=600)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--no-carry", action="store_true", help="labels only teach")
    given = parser.parse_args()
    budget = SceneBudget(keyframes=given.keyframes, unlabelled=FRAMES - given.keyframes)
    suite = replace_scene(SuiteConfig(split="val", protocol="scratch"), budget)
    rows: dict[str, list[tuple[ConfusionMatrix, ConfusionMatrix, float]]] = {v: [] for v in given.variants}
    for seed in given.rooms:
        room = make_benchmark_room(seed, suite)
        began = time.process_time()
        _, base, labelled = fitted_grid(room, suite, given.grid_steps)
        print(f"room {seed}: geometry, colours and features {time.process_time() - began:.0f} CPU s", flush=True)
        for variant in given.variants:
            began = time.process_time()
            field = with_classes(base, labelled, variant, given.steps, carry=not given.no_carry)
            spent = time.process_time() - began
            rows[variant].append(
                (score(room, field, suite, own_image=True), score(room, field, suite, own_image=False), spent)
            )
    for variant, found in rows.items():
        seen, blind = sum_of([row[0] for row in found]), sum_of([row[1] for row in found])
        cpu = np.mean([row[2] for row in found])
        print(f"| {variant} | {seen} | {blind} | {cpu:.0f} |", flush=True)


def replace_scene(suite: SuiteConfig, budget: SceneBudget) -> SuiteConfig:
    """The suite with another budget."""
    return msgspec.structs.replace(suite, scene=budget)


def sum_of(parts: list[ConfusionMatrix]) -> str:
    """mIoU and total accuracy of all rooms together, per cent."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    figures = total.metrics()
    return f"{100 * (figures.miou or 0):.1f}; {100 * (figures.total_accuracy or 0):.1f}"


if __name__ == "__main__":
    main()
