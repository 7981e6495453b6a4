"""Maps before and after ``refine`` against the truth: mIoU, and pictures of classes.

Example: python -m research.experiments.refined_maps runs/kitchen/map.npz refined.npz --truth redkitchen
Example: python -m research.experiments.refined_maps room.npz refined.npz --truth 100000 --out refined.png
Example: python -m research.experiments.refined_maps map.npz refined.npz --truth redkitchen --log kitchen.mcap
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.evaluation.room_map import NEAR_M, true_surface
from research.scenes import CameraPathConfig, make_room, room_frames
from research.scenes.sequence import room_views
from research.suites.config import SequenceConfig, camera_of_width
from semantic_mapper.evaluation.metrics import ConfusionMatrix, map_confusion
from semantic_mapper.fields.nesf import load_nesf
from semantic_mapper.labels import NYU40, LabelSet
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import (
    Curve,
    Panel,
    class_colors,
    class_rows,
    draw_panels,
    new_figure,
    put_legend,
    put_picture,
    rendered,
    write_picture,
)
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Float32, PosedFrame, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT, HEAD = 260, 195, 28  # of a panel and of the names above, pixels
ROOM_FRAMES = 40


class Labelled(NamedTuple):
    """Points (N, 3) with ids (N,) of the map's label set."""

    xyz: Float32
    label: UInt8


def read_truth(truth: str, label_set: LabelSet) -> Labelled:
    """Of a room by its seed, or of a recording's folder with mesh_labels.npz and labels.json (ids of NYU40)."""
    if truth.isdigit():
        walk = CameraPathConfig(step_m=SequenceConfig().step_m)
        frames = room_frames(int(truth), ROOM_FRAMES, camera_of_width(32), path=walk)
        surface = true_surface(make_room(int(truth)), [frame.T_world_camera for frame in frames])
        return Labelled(surface.xyz, surface.label)
    mesh = np.load(Path(truth) / "mesh_labels.npz")
    named = set(json.loads((Path(truth) / "labels.json").read_text(encoding="utf-8"))["classes"].values())
    assert named - {"ignore"} <= set(NYU40.names), "the mesh has ids of NYU40"
    label = label_set.to_ids(label_set.channel_map_from(NYU40)[mesh["label"]])
    return Labelled(mesh["vertices"], label)


def score(map_: Labelled, truth: Labelled, label_set: LabelSet) -> ConfusionMatrix:
    """At the points of the truth; where the map has no point near by, it is wrong."""
    return map_confusion(truth.xyz, truth.label, map_.xyz, map_.label, label_set, max_distance_m=NEAR_M)


@rendered
def draw(rows: Sequence[Sequence[UInt8]], names: Sequence[str], label_set: LabelSet) -> Figure:
    """A picture a name beside each other: colours (h, w, 3), then classes (h, w); and below what the classes are."""
    shown = [classes for row in rows for classes in row[1:]]
    legend = [(name, colour, None) for name, colour, _ in class_rows(np.zeros(0, np.uint8), label_set, shown)]
    width, columns = WIDTH * len(names), 6
    foot = HEAD + HEIGHT * len(rows)
    legend_height = 22 * -(-len(legend) // columns)
    figure = new_figure(width, foot + legend_height + 10)
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            box = (column * WIDTH, HEAD + row * HEIGHT, WIDTH - 4, HEIGHT - 4)
            coloured = class_colors(picture, label_set) if column else picture
            put_picture(figure, box, coloured, names[column] if row == 0 else "")
    put_legend(figure, (8, foot + 4, width - 16, legend_height), legend, columns)
    return figure


def draw_curves(history: Sequence[Mapping[str, float]], validation: Mapping[str, float]) -> UInt8:
    """What the validation maps said while a network was trained, and of what was saved (``recipe`` of its weights).

    Both against smoothed votes, from which training starts.
    """
    start, last = history[0], history[-1]["step"]
    panels = [
        Panel(
            f"{name}, validation rooms, over smoothed votes",
            unit,
            "step",
            [
                Curve("network", [(h["step"], factor * (h[key] - start[key])) for h in history], marked=True),
                Curve("as saved, blended", [(last, factor * (validation[key] - start[key]))]),
            ],
        )
        for key, name, unit, factor in (("miou", "mIoU", "points", 100), ("loss", "cross-entropy", "nats", 1))
    ]
    return draw_panels("", panels)


class Seen(NamedTuple):
    """A frame that maps are looked at from, and its labels (H, W), ids of the maps' classes, where they are known."""

    frame: PosedFrame
    label: UInt8 | None


def room_looks(seed: int, numbers: Sequence[int]) -> list[Seen]:
    """Frames of a room's walk."""
    walk = CameraPathConfig(step_m=SequenceConfig().step_m)
    found = list(room_views(seed, max(numbers) + 1, camera_of_width(320), path=walk))
    return [Seen(v.frame, v.frame.label) for v in (found[n] for n in numbers)]


def log_looks(log: Path, numbers: Sequence[int], label_set: LabelSet) -> list[Seen]:
    """Frames of a log."""
    with open_log(log) as reader:
        theirs = reader.info.label_set
        table = None if theirs is None else label_set.to_ids(label_set.channel_map_from(theirs))
        return [
            Seen(frame, None if table is None or frame.label is None else table[frame.label])
            for n, frame in enumerate(reader)
            if n in numbers
        ]


def views(looks: Sequence[Seen], maps: Sequence[VoxelMap]) -> list[list[UInt8]]:
    """Of each frame: its colours, the classes of each map seen from there, the true ones."""
    rows: list[list[UInt8]] = []
    for frame, label in looks:
        classes = [voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics).label for voxel_map in maps]
        rows.append([frame.rgb, *classes, *([] if label is None else [label])])
    return rows


def main() -> None:
    """Print a line a map, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--truth", required=True, help="seed of a room, or folder of a recording")
    parser.add_argument("--frames", nargs="+", type=int, default=[5, 25], help="of the room's walk or the log, to draw")
    parser.add_argument("--log", type=Path, help="of a recording, to draw")
    parser.add_argument("--out", type=Path, help="picture")
    parser.add_argument("--weights", type=Path, help="whose training to draw")
    parser.add_argument("--curves", type=Path, help="picture of that")
    arguments = parser.parse_args()
    loaded = [VoxelMap.load(path) for path in arguments.maps]
    label_set = loaded[0].label_set
    truth = read_truth(arguments.truth, label_set)
    for path, voxel_map in zip(arguments.maps, loaded, strict=True):
        points = voxel_map.points()
        found = score(Labelled(points.xyz, points.label), truth, label_set).metrics()
        print(f"{path}: mIoU {100 * (found.miou or 0):.1f} %, total accuracy {100 * (found.total_accuracy or 0):.1f} %")
    if arguments.out:
        if arguments.log:
            looks = log_looks(arguments.log, arguments.frames, label_set)
        else:
            looks = room_looks(int(arguments.truth), arguments.frames)
        names = ("colour", *(path.stem for path in arguments.maps), "truth")
        write_picture(arguments.out, draw(views(looks, loaded), names, label_set))
    if arguments.curves:
        recipe = load_nesf(arguments.weights).recipe
        write_picture(arguments.curves, draw_curves(recipe["history"], recipe["validation"]))


if __name__ == "__main__":
    main()
