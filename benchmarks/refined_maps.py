"""Maps before and after ``refine`` against the truth: mIoU, and a picture.

Example: python -m benchmarks.refined_maps runs/kitchen/map.npz refined.npz --truth redkitchen
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
from semantic_mapper.labels import NYU40, ROOMS, LabelSet
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import new_figure, rendered, write_picture
from semantic_mapper.replay.evaluate.room_map import NEAR_M, in_rooms, true_surface
from semantic_mapper.scenes import CameraPathConfig, make_room, room_frames
from semantic_mapper.types import Float32, UInt8

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
def draw(rows: Sequence[Sequence[UInt8]], names: Sequence[str]) -> Figure:
    """Pictures (h, w, 3) in rows, one column a name."""
    width, height = WIDTH * len(names), HEIGHT * len(rows) + HEAD
    figure = new_figure(width, height)
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            bottom = (len(rows) - 1 - row) * HEIGHT / height
            axes = figure.add_axes((column * WIDTH / width, bottom, (WIDTH - 4) / width, (HEIGHT - 4) / height))
            axes.imshow(picture, interpolation="nearest")
            axes.set_axis_off()
            if row == 0:
                axes.set_title(names[column], fontsize=10)
    return figure


def views(seed: int, numbers: Sequence[int], maps: Sequence[VoxelMap]) -> list[list[UInt8]]:
    """A row for each frame of a room's walk: its colours, the classes of each map seen from there, the true ones."""
    walk = CameraPathConfig(step_m=SequenceConfig().step_m)
    frames = list(room_frames(seed, max(numbers) + 1, camera_of_width(320), path=walk))
    rows: list[list[UInt8]] = []
    for frame in (frames[number] for number in numbers):
        assert frame.label is not None
        casts = [voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics) for voxel_map in maps]
        labels = [ROOMS.colorize(in_rooms(cast.label, m.label_set)) for cast, m in zip(casts, maps, strict=True)]
        rows.append([frame.rgb, *labels, ROOMS.colorize(frame.label)])
    return rows


def main() -> None:
    """Print a line a map, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--truth", required=True, help="seed of a room, or folder of a recording")
    parser.add_argument("--frames", nargs="+", type=int, default=[5, 15, 25], help="of the room's walk, to draw")
    parser.add_argument("--out", type=Path, help="picture, of rooms only")
    arguments = parser.parse_args()
    loaded = [VoxelMap.load(path) for path in arguments.maps]
    label_set = loaded[0].label_set
    truth = read_truth(arguments.truth, label_set)
    for path, voxel_map in zip(arguments.maps, loaded, strict=True):
        points = voxel_map.points()
        found = score(Labelled(points.xyz, points.label), truth, label_set).metrics()
        print(f"{path}: mIoU {100 * (found.miou or 0):.1f} %, total accuracy {100 * (found.total_accuracy or 0):.1f} %")
    if arguments.out:
        names = ("colour", *(path.stem for path in arguments.maps), "truth")
        write_picture(arguments.out, draw(views(int(arguments.truth), arguments.frames, loaded), names))


if __name__ == "__main__":
    main()
