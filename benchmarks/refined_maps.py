"""Maps before and after ``refine`` against the truth: mIoU, and pictures of classes and of things.

Example: python -m benchmarks.refined_maps runs/kitchen/map.npz refined.npz --truth redkitchen
Example: python -m benchmarks.refined_maps room.npz refined.npz --truth 100000 --out refined.jpg
Example: python -m benchmarks.refined_maps map.npz refined.npz --truth redkitchen --log kitchen.mcap --out kitchen.jpg
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from semantic_mapper.benchmark.config import SequenceConfig, camera_of_width
from semantic_mapper.evaluation.metrics import ConfusionMatrix, map_confusion
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.labels import NYU40, ROOMS, STUFF_NAMES, LabelSet
from semantic_mapper.mapping.map_types import MapView
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.plots import new_figure, rendered, write_picture
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.replay.evaluate.room_map import NEAR_M, true_surface
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.scenes import CameraPathConfig, make_room, room_frames
from semantic_mapper.scenes.sequence import room_views
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


class Seen(NamedTuple):
    """A frame that maps are looked at from: with the true labels (H, W) and things (H, W), where they are known."""

    frame: PosedFrame
    label: UInt8 | None
    instance: NDArray[np.int64] | None


def room_looks(seed: int, numbers: Sequence[int]) -> list[Seen]:
    """Frames of a room's walk."""
    walk = CameraPathConfig(step_m=SequenceConfig().step_m)
    found = list(room_views(seed, max(numbers) + 1, camera_of_width(320), path=walk))
    return [Seen(v.frame, v.frame.label, v.rendered.instance.astype(np.int64)) for v in (found[n] for n in numbers)]


def log_looks(log: Path, numbers: Sequence[int]) -> list[Seen]:
    """Frames of a log."""
    with open_log(log) as reader:
        return [Seen(frame, None, None) for n, frame in enumerate(reader) if n in numbers]


class Things:
    """The things of a map, as queries find them, to be seen from anywhere."""

    def __init__(self, voxel_map: VoxelMap, up: tuple[float, float, float]) -> None:
        found = InstanceTracker(up=up).update(MapMirror.of(voxel_map).snapshot())
        self._voxel_m = voxel_map.config.voxel_size_m
        self._tree = KDTree(np.concatenate([thing.voxels for thing in found]))
        self._number = np.repeat([thing.id for thing in found], [len(thing.voxels) for thing in found])

    def seen(self, view: MapView, frame: PosedFrame) -> UInt8:
        """Picture (H, W, 3)."""
        hit = view.depth_m > 0
        xyz = transform(frame.T_world_camera, unproject(view.depth_m, frame.intrinsics)[hit])
        _, nearest = self._tree.query(xyz / self._voxel_m, distance_upper_bound=2.0)
        number = np.zeros(hit.shape, np.int64)
        number[hit] = np.append(self._number, 0)[nearest]
        return in_colours(number)


def in_colours(number: NDArray[np.int64]) -> UInt8:
    """Picture (H, W, 3) of numbers (H, W); 0 is grey."""
    colours = np.random.default_rng(3).integers(40, 256, (4096, 3), np.uint8)
    colours[0] = 90
    return colours[number % 4096]


def views(looks: Sequence[Seen], maps: Sequence[VoxelMap], up: tuple[float, float, float]) -> list[list[UInt8]]:
    """Two rows for each frame: its colours, the classes of each map seen from there, the true ones; then the things."""
    things = [Things(voxel_map, up) for voxel_map in maps]
    rows: list[list[UInt8]] = []
    for frame, label, instance in looks:
        casts = [voxel_map.ray_cast(frame.T_world_camera, frame.intrinsics) for voxel_map in maps]
        classes = [m.label_set.colorize(cast.label) for cast, m in zip(casts, maps, strict=True)]
        rows.append([frame.rgb, *classes])
        rows.append([frame.rgb, *(found.seen(cast, frame) for found, cast in zip(things, casts, strict=True))])
        if label is not None and instance is not None:
            stuff = np.isin(label, ROOMS.thing_ids(STUFF_NAMES), invert=True)
            rows[-2].append(ROOMS.colorize(label))
            rows[-1].append(in_colours(np.where(stuff, 0, instance)))
    return rows


def main() -> None:
    """Print a line a map, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--truth", required=True, help="seed of a room, or folder of a recording")
    parser.add_argument("--frames", nargs="+", type=int, default=[5, 25], help="of the room's walk or the log, to draw")
    parser.add_argument("--log", type=Path, help="of a recording, to draw")
    parser.add_argument("--up", nargs=3, type=float, default=(0.0, 0.0, 1.0))
    parser.add_argument("--out", type=Path, help="picture")
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
            looks = log_looks(arguments.log, arguments.frames)
        else:
            looks = room_looks(int(arguments.truth), arguments.frames)
        names = ("colour", *(path.stem for path in arguments.maps), *([] if arguments.log else ["truth"]))
        write_picture(arguments.out, draw(views(looks, loaded, tuple(arguments.up)), names))


if __name__ == "__main__":
    main()
