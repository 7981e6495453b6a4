"""Pictures of NeSF on KLEVR, after ``benchmark klevr``: novel scenes at test cameras (image, true classes,
NeSF's, the U-Net's), and how the networks of its arms learned.

Example: python -m research.experiments.klevr_picture --folder runs/klevr-grids --out nesf.jpg --curves curves.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2

from research.scenes.suite import KLEVR_SUITE
from research.suites.klevr import TEST_CAMERAS, KlevrConfig, novel_seeds, scene_frames, scored_numbers
from research.suites.klevr_grids import NEAR_M, scene_density
from research.suites.klevr_images import unet_network
from research.suites.klevr_nesf import (
    NESF_ARMS,
    arm_network,
    grid_config,
    nesf_curve,
    scene_grid,
)
from research.train.grid_nesf import SceneLabels
from semantic_mapper.config import load_config
from semantic_mapper.plots import Curve, Panel, draw_panels, draw_picture_rows, write_picture
from semantic_mapper.types import UInt8

WIDTH = 216  # of a picture, pixels


def picture(config: KlevrConfig, folder: Path, columns: int) -> UInt8:
    """A column for each scene."""
    model, _ = arm_network(config, "nesf", folder)
    unet, _ = unet_network(config, folder)
    label_set = KLEVR_SUITE.label_set
    rows: dict[str, list[UInt8]] = {"image": [], "true classes": [], "NeSF": [], "U-Net": []}
    for scene in novel_seeds(config)[:columns]:
        labels = SceneLabels(model, scene_grid(scene_density(grid_config(config), scene, folder)), NEAR_M)
        (frame,) = scene_frames(config, scene, scored_numbers(config, scene)[TEST_CAMERAS][:1])
        assert frame.label is not None
        said = (frame.label, labels.frame(frame), unet.predict(frame))
        for row, shown in zip(rows.values(), (frame.rgb, *map(label_set.colorize, said)), strict=True):
            row.append(shown)
    return draw_picture_rows(rows, label_set, WIDTH)


def curves(config: KlevrConfig, folder: Path) -> UInt8:
    """What the points of novel scenes, and the rays of training, say of each arm that was run."""
    found = {name: nesf_curve(config, name, folder) for name in NESF_ARMS}
    named = {f"{name}, {curve[-1].step:,} steps": curve for name, curve in found.items() if curve}
    points = [Curve(n, [(p.step, 100 * p.miou_points) for p in c], True) for n, c in named.items()]
    entropy = [Curve(n, [(p.step, p.cross_entropy) for p in c], True) for n, c in named.items()]
    panels = [
        Panel("points of novel scenes", "mIoU, %", "steps", points),
        Panel("rays of training", "cross-entropy of balanced rays", "steps", entropy),
    ]
    return draw_panels("NeSF's arms while they learn", panels, size=(640, 400))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--curves", type=Path)
    parser.add_argument("--columns", type=int, default=6)
    arguments = parser.parse_args()
    config = load_config(arguments.config, KlevrConfig) if arguments.config else KlevrConfig()
    image = picture(config, arguments.folder, arguments.columns)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), image[..., ::-1])
    if arguments.curves is not None:
        write_picture(arguments.curves, curves(config, arguments.folder))


if __name__ == "__main__":
    main()
