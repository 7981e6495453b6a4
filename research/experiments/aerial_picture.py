"""A picture of AERIAL's first town, after ``benchmark aerial``: its labelled views, and what IRT (the default of
``finetune``) and the U-Net say of views that are held out, by day and in the dark.

Example: python -m research.experiments.aerial_picture --folder runs/aerial-grids --out town.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from research.scenes.suite import AERIAL_SUITE
from research.suites.aerial import (
    DARK,
    DAY,
    AerialConfig,
    Predict,
    episodes,
    labelled_frames,
    scored_views,
)
from research.suites.aerial_arms import IMAGE_FITS
from research.suites.aerial_irt import irt_fits
from semantic_mapper.config import load_config
from semantic_mapper.plots import draw_picture_rows
from semantic_mapper.types import UInt8

SHOWN = {"IRT": "irt-bc", "U-Net": "unet"}
COLUMNS, WIDTH_PX = 4, 150


def picture(config: AerialConfig, fitted: Mapping[str, Predict]) -> UInt8:
    """(H, W, 3) of the first episode.

    Args:
        config: Of the run.
        fitted: What answers, by caption.
    """
    label_set, episode = AERIAL_SUITE.label_set, episodes(config)[0]
    labelled = labelled_frames(config, episode)[:COLUMNS]
    rows = {
        "labelled view": [frame.rgb for frame in labelled],
        "its classes": [label_set.colorize(frame.label) for frame in labelled if frame.label is not None],
    }
    for kind, caption in ((DAY, ""), (DARK, ", dark")):
        views = scored_views(config, episode, kind)
        views = [views[int(k)] for k in np.linspace(1, len(views) - 2, COLUMNS).round()]
        rows["in the dark" if kind == DARK else "held-out view"] = [view.frame.rgb for view in views]
        if kind == DAY:
            rows["true classes"] = [label_set.colorize(view.rendered.label) for view in views]
        for name, predict in fitted.items():
            rows[name + caption] = [label_set.colorize(predict(view.frame, 1)) for view in views]
    return draw_picture_rows(rows, label_set, WIDTH_PX)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    config = load_config(arguments.config, AerialConfig) if arguments.config else AerialConfig()
    fits, episode = IMAGE_FITS | irt_fits(arguments.folder), episodes(config)[0]
    image = picture(config, {caption: fits[name](config, episode) for caption, name in SHOWN.items()})
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(arguments.out), image[..., ::-1])


if __name__ == "__main__":
    main()
