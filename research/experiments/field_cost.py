"""Size and CPU cost of every kind of field: parameters, and one forward and backward pass of a training step.

One step is 512 rays of 8 guided samples and 6 source views of 160x120, one of them the query view, losses of the
trainer included. All kinds run in one process, one after the other in each round, and the fastest of several rounds
counts: what else the machine does only ever adds. Quote ratios.

    python -m research.experiments.field_cost [--rounds 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from semantic_mapper.config import SRayConfig
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.registry import build_field, field_names
from semantic_mapper.labels import ROOMS
from semantic_mapper.training.step import StepConfig, training_loss
from semantic_mapper.training.views import LabelledView
from semantic_mapper.types import CameraIntrinsics

INTRINSICS = CameraIntrinsics(110.3, 110.3, 79.5, 59.5, 160, 120)
VIEWS = 6
STEP = StepConfig(rays=512, depth_dropout=0.0)
VARIANTS = {"sray, no known labels": ("sray", SRayConfig(source_labels=False))}


def made_up_views() -> list[LabelledView]:
    """Views of nothing in particular: the cost does not depend on what they show."""
    generator = torch.Generator().manual_seed(0)
    shape = (INTRINSICS.height, INTRINSICS.width)
    views: list[LabelledView] = []
    for i in range(VIEWS):
        pose = torch.eye(4)
        pose[0, 3] = 0.1 * i
        views.append(
            LabelledView(
                rgb=torch.rand(3, *shape, generator=generator),
                depth_m=2 + 0.5 * torch.rand(shape, generator=generator),
                channel=torch.randint(len(ROOMS), shape, generator=generator),
                intrinsics=INTRINSICS,
                T_world_camera=pose,
            )
        )
    return views


def step_seconds(model: LearnedField, views: list[LabelledView]) -> tuple[float, float]:
    """Wall and CPU seconds of one forward and backward pass."""
    generator = torch.Generator().manual_seed(1)
    model.zero_grad()
    wall, cpu = time.perf_counter(), time.process_time()
    loss = training_loss(model, views, 2, range(VIEWS), STEP, generator)
    assert loss is not None
    loss.total.backward()  # pyright: ignore[reportUnknownMemberType]
    return time.perf_counter() - wall, time.process_time() - cpu


def measure(rounds: int) -> dict[str, dict[str, float]]:
    """One row a name: parameters in thousands (all, and those that got a gradient), milliseconds of wall and CPU."""
    names = {name: (name, {}) for name in field_names()} | VARIANTS
    models = {row: build_field(name, config, ROOMS) for row, (name, config) in names.items()}
    views = made_up_views()
    best = dict.fromkeys(models, (float("inf"), float("inf")))
    for _ in range(rounds + 1):  # one more to warm up, which will not be the fastest
        for row, model in models.items():
            best[row] = min(best[row], step_seconds(model, views), key=lambda t: t[1])
    return {
        row: {
            "parameters_k": round(sum(p.numel() for p in model.parameters()) / 1e3, 1),
            "trained_k": round(sum(p.numel() for p in model.parameters() if p.grad is not None) / 1e3, 1),
            "wall_ms": round(best[row][0] * 1e3, 1),
            "cpu_ms": round(best[row][1] * 1e3, 1),
        }
        for row, model in models.items()
    }


def main() -> None:
    """Print a Markdown table; with ``--json`` also write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows = measure(options.rounds)
    base = rows["sray"]["cpu_ms"]
    print("| field | parameters, k | of them trained, k | wall ms | CPU ms | CPU against S-Ray |")
    print("|---|---|---|---|---|---|")
    for row, r in rows.items():
        fraction = r["cpu_ms"] / base
        print(f"| {row} | {r['parameters_k']} | {r['trained_k']} | {r['wall_ms']} | {r['cpu_ms']} | {fraction:.2f} |")
    print(f"\n{torch.get_num_threads()} threads, torch {torch.__version__}")
    if options.json is not None:
        options.json.write_text(json.dumps({"threads": torch.get_num_threads(), "fields": rows}, indent=1))


if __name__ == "__main__":
    main()
