"""Errors of the computed depth that training rooms have, against their measured depth, and what it costs.

Example: python -m research.experiments.computed_training_depth research/recipes/cpu-2h.toml --rooms 12
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import msgspec
import numpy as np
import torch

from research.scenes import TRAIN_SEEDS
from research.train.rooms import PackedRoom, RoomPoolConfig, pack_room
from research.train.train_config import TrainConfig
from semantic_mapper.config import load_config
from semantic_mapper.fields.source_maps import UNSURE_SPREAD


def main() -> None:
    """Render rooms both ways and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--first", type=int, default=5000, help="place of the first room among the training seeds")
    options = parser.parse_args()
    torch.set_num_threads(1)
    pool = load_config(options.recipe, TrainConfig).pool
    seeds = TRAIN_SEEDS[options.first : options.first + options.rooms]
    measured_s, _ = _render(seeds, msgspec.structs.replace(pool, computed_depth=0.0))
    computed_s, rooms = _render(seeds, msgspec.structs.replace(pool, computed_depth=1.0))
    rows = [row for room in rooms for row in _errors(room)]
    views = sum(len(room.depth_m) for room in rooms)
    error, half, shown, shown_error = np.nanmean(np.array(rows), axis=0)
    print(f"rooms {len(rooms)}, views {views}, of these with depth {len(rows)}")
    print(f"abs-rel of all pixels {100 * error:.1f} %, of the surer half {100 * half:.1f} %")
    print(f"shown to the encoder {100 * shown:.0f} % of the pixels, abs-rel {100 * shown_error:.1f} %")
    print(f"CPU seconds a room: {computed_s / len(seeds):.2f}, with measured depth {measured_s / len(seeds):.2f}")


def _render(seeds: range, pool: RoomPoolConfig) -> tuple[float, list[PackedRoom]]:
    began = time.process_time()
    rooms = [room for seed in seeds if isinstance(room := pack_room(seed, pool), PackedRoom)]
    return time.process_time() - began, rooms


def _errors(room: PackedRoom) -> list[tuple[float, float, float, float]]:
    """Of each view with depth: abs-rel of all pixels and of the surer half, fraction that is shown, its abs-rel."""
    assert room.computed_m is not None and room.computed_sigma_m is not None
    rows: list[tuple[float, float, float, float]] = []
    for measured, depth, sigma in zip(room.depth_m, room.computed_m, room.computed_sigma_m, strict=True):
        known = (measured > 0) & (depth > 0)
        if not known.any():
            continue
        truth = measured[known]
        error, spread = np.abs(depth[known] - truth) / truth, sigma[known] / depth[known]
        shown = spread <= UNSURE_SPREAD
        of_shown = float(error[shown].mean()) if shown.any() else np.nan
        half = float(error[spread <= np.median(spread)].mean())
        rows.append((float(error.mean()), half, float(shown.mean()), of_shown))
    return rows


if __name__ == "__main__":
    main()
