"""Maps before and after ``refine`` against the truth: mIoU, and a picture from above.

Example: python -m benchmarks.refined_maps runs/kitchen/map.npz refined.npz --truth redkitchen --out refined.png
Example: python -m benchmarks.refined_maps room.npz refined.npz --truth 200000 --out refined.png
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from semantic_mapper.benchmark.config import SequenceConfig, camera_of_width
from semantic_mapper.evaluation.metrics import ConfusionMatrix, map_confusion
from semantic_mapper.labels import NYU40, LabelSet
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import new_figure, put_title, rendered, write_picture
from semantic_mapper.replay.evaluate.room_map import NEAR_M, true_surface
from semantic_mapper.scenes import CameraPathConfig, make_room, room_frames
from semantic_mapper.types import Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 420, 380  # of a panel, pixels
CUT_M = 2.0  # what is higher above the floor hides the rest
ROOM_FRAMES = 40


class Labelled(NamedTuple):
    """Points (N, 3) with ids (N,) of the map's label set; to_level (3, 3) turns their up to z."""

    name: str
    xyz: Float64
    label: UInt8
    to_level: Float64


def read_truth(truth: str, label_set: LabelSet) -> Labelled:
    """Of a room by its seed, or of a recording's folder with mesh_labels.npz and labels.json (ids of NYU40)."""
    if truth.isdigit():
        walk = CameraPathConfig(step_m=SequenceConfig().step_m)
        frames = room_frames(int(truth), ROOM_FRAMES, camera_of_width(32), path=walk)
        surface = true_surface(make_room(int(truth)), [frame.T_world_camera for frame in frames])
        return Labelled("truth", surface.xyz.astype(np.float64), surface.label, np.eye(3))
    mesh = np.load(Path(truth) / "mesh_labels.npz")
    named = set(json.loads((Path(truth) / "labels.json").read_text(encoding="utf-8"))["classes"].values())
    assert named - {"ignore"} <= set(NYU40.names), "the mesh has ids of NYU40"
    label = label_set.to_ids(label_set.channel_map_from(NYU40)[mesh["label"]])
    return Labelled("truth", mesh["vertices"].astype(np.float64), label, mesh["T_gravity"][:3, :3])


def score(map_: Labelled, truth: Labelled, label_set: LabelSet) -> ConfusionMatrix:
    """At the points of the truth; where the map has no point near by, it is wrong."""
    near = (map_.xyz.astype(np.float32), map_.label, label_set)
    return map_confusion(truth.xyz.astype(np.float32), truth.label, *near, max_distance_m=NEAR_M)


@rendered
def draw(clouds: Sequence[Labelled], label_set: LabelSet, title: str) -> Figure:
    """Panels side by side, from above, without what is above ``CUT_M``."""
    width, height = WIDTH * len(clouds), HEIGHT + 60
    figure = new_figure(width, height)
    put_title(figure, title, "from above, without ceiling and upper walls")
    level = [cloud.xyz @ cloud.to_level.T for cloud in clouds]
    low, high = np.quantile(level[0], (0.005, 0.995), axis=0)
    for column, (cloud, xyz) in enumerate(zip(clouds, level, strict=True)):
        box = (column * WIDTH / width, 0, (WIDTH - 6) / width, (HEIGHT - 24) / height)
        axes = figure.add_axes(box)
        shown = (xyz[:, 2] < low[2] + CUT_M) & (cloud.label != label_set.ignore_id)
        order = np.flatnonzero(shown)[np.argsort(xyz[shown, 2])]
        axes.scatter(xyz[order, 0], xyz[order, 1], c=label_set.colorize(cloud.label[order]) / 255, s=0.6, linewidths=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_axis_off()
        axes.set_title(cloud.name, fontsize=9)
    return figure


def main() -> None:
    """Print a line a map, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--truth", required=True, help="seed of a room, or folder of a recording")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    loaded = [VoxelMap.load(path) for path in arguments.maps]
    label_set = loaded[0].label_set
    truth = read_truth(arguments.truth, label_set)
    clouds: list[Labelled] = []
    for path, voxel_map in zip(arguments.maps, loaded, strict=True):
        points = voxel_map.points()
        clouds.append(Labelled(path.stem, points.xyz.astype(np.float64), points.label, truth.to_level))
        found = score(clouds[-1], truth, label_set).metrics()
        print(f"{path}: mIoU {100 * (found.miou or 0):.1f} %, total accuracy {100 * (found.total_accuracy or 0):.1f} %")
    if arguments.out:
        write_picture(arguments.out, draw([*clouds, truth], label_set, "A map before and after refine"))


if __name__ == "__main__":
    main()
