"""Novel KLEVR scenes at test cameras: image, true classes, those of NeSF. After ``benchmark klevr --arm nesf``.

Example: python -m benchmarks.klevr_picture --config klevr.toml --folder runs/klevr-grids --out nesf.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.benchmark.klevr import TEST_CAMERAS, KlevrConfig, novel_seeds, scene_frames, scored_numbers
from semantic_mapper.benchmark.klevr_grids import NEAR_M, scene_density
from semantic_mapper.benchmark.klevr_nesf import grid_config, nesf_network, scene_grid, training_of
from semantic_mapper.config import load_config
from semantic_mapper.scenes.suite import KLEVR_SUITE
from semantic_mapper.training.grid_nesf import SceneLabels
from semantic_mapper.types import UInt8

ENLARGED, GAP_PX = 2, 4


def picture(config: KlevrConfig, folder: Path, columns: int) -> UInt8:
    """A column for each scene."""
    model = nesf_network(config, training_of(config), folder)
    found: list[UInt8] = []
    for scene in novel_seeds(config)[:columns]:
        labels = SceneLabels(model, scene_grid(scene_density(grid_config(config), scene, folder)), NEAR_M)
        (frame,) = scene_frames(config, scene, scored_numbers(config, scene)[TEST_CAMERAS][:1])
        assert frame.label is not None
        shown = (frame.rgb, *(KLEVR_SUITE.label_set.colorize(ids) for ids in (frame.label, labels.frame(frame))))
        found.append(np.concatenate([_framed(tile) for tile in shown]))
    return np.concatenate(found, axis=1)


def _framed(tile: UInt8) -> UInt8:
    enlarged = tile.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
    return np.pad(enlarged, ((GAP_PX, 0), (GAP_PX, 0), (0, 0)), constant_values=255)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--columns", type=int, default=6)
    arguments = parser.parse_args()
    config = load_config(arguments.config, KlevrConfig) if arguments.config else KlevrConfig()
    image = picture(config, arguments.folder, arguments.columns)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), image[..., ::-1])


if __name__ == "__main__":
    main()
