"""A recording cut into two visits, with a thing taken out of the second: it has gone, and nothing else has changed.

    python -m research.experiments.days_recording path/to/redkitchen --things 3 12 65 66

The folder has ``label``, ``instance`` and ``mesh_labels.npz`` (``vertices``, ``faces``, ``label``, ``instance``,
``T_gravity``). Where a frame of the second visit shows the thing, or a pixel beside it, it gets the depth and the class
of the mesh without the thing, under which a level lid closes what the thing stood on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from research.experiments.days import Labelled, Report, compare, near, visit_of
from semantic_mapper.geometry import transform
from semantic_mapper.labels import NYU40
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.queries.revisit import MapVisit
from semantic_mapper.replay.importers.base import ImportOptions
from semantic_mapper.replay.importers.folder import open_folder
from semantic_mapper.types import Float64, Int64, PosedFrame

BESIDE_PX = 11  # side of the square by which a thing is widened
LID_M = 0.05  # by which the lid reaches beyond it


class Room:
    """A recording and its mesh, z up."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._recording = folder, open_folder(folder, ImportOptions())
        with np.load(folder / "mesh_labels.npz") as mesh:
            self.T = mesh["T_gravity"].astype(np.float64)
            self._vertices = transform(self.T, mesh["vertices"].astype(np.float64))
            self._faces, self._label, self._instance = mesh["faces"], mesh["label"], mesh["instance"]

    def box_of(self, number: int) -> Float64:
        """Low and high corner (2, 3) of a thing."""
        points = self._vertices[self._instance == number]
        return np.percentile(points, (1, 99), axis=0)

    def visit(self, day: int, without: int | None = None) -> MapVisit:
        """The map of the first or the second half of the frames."""
        mapper, count = Labelled(NYU40), len(self._recording)
        for frame in self._frames(range(day * count // 2, (day + 1) * count // 2), without):
            mapper.add(frame)
        return visit_of(mapper.voxel_map)

    def _frames(self, numbers: Sequence[int], without: int | None) -> Iterator[PosedFrame]:
        scene, labels = self._emptied(without) if without is not None else (None, np.zeros(0))
        for n in numbers:
            loaded = self._recording.load(n).frame
            frame = replace(loaded, T_world_camera=self.T @ loaded.T_world_camera)
            if scene is not None:
                path = self._folder / "instance" / f"{n:06d}.png"
                image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
                shown = cv2.dilate((image == without).astype(np.uint8), np.ones((BESIDE_PX, BESIDE_PX), np.uint8))
                frame = _filled(frame, np.argwhere(shown > 0), scene, labels)
            yield frame

    def _emptied(self, number: int):
        kept = ~(self._instance[self._faces] == number).any(axis=1)
        low, high = self.box_of(number)
        low[:2], high[:2] = low[:2] - LID_M, high[:2] + LID_M
        lid = np.array([(x, y, low[2]) for x in (low[0], high[0]) for y in (low[1], high[1])])
        start = len(self._vertices)
        faces = np.concatenate((self._faces[kept], start + np.array(((0, 1, 2), (1, 2, 3)))))
        scene, tensor = load_open3d().t.geometry.RaycastingScene(), load_open3d().core.Tensor
        points = np.concatenate((self._vertices, lid)).astype(np.float32)
        scene.add_triangles(tensor(points), tensor(faces.astype(np.uint32)))
        return scene, np.append(self._label[faces[:-2, 0]], (0, 0)).astype(np.uint8)


def _filled(frame: PosedFrame, pixels: Int64, scene, labels) -> PosedFrame:
    assert frame.depth_m is not None and frame.label is not None
    k, (v, u) = frame.intrinsics, pixels.T
    rays = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(len(u))), axis=1) @ frame.T_world_camera[:3, :3].T
    start = np.broadcast_to(frame.T_world_camera[:3, 3], rays.shape)
    hit = scene.cast_rays(load_open3d().core.Tensor(np.hstack((start, rays)).astype(np.float32)))
    depth, label, found = frame.depth_m.copy(), frame.label.copy(), hit["t_hit"].numpy()
    face = hit["primitive_ids"].numpy().astype(np.int64)
    seen = np.isfinite(found)
    depth[v, u] = np.where(seen, found, 0)
    label[v, u] = np.where(seen, labels[np.where(seen, face, 0)], 0)
    return replace(frame, depth_m=depth, label=label)


def main() -> None:
    """Print what is reported for each thing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--things", type=int, nargs="+", default=[3, 12, 65, 66])
    arguments = parser.parse_args()
    room = Room(arguments.folder)
    before = room.visit(0)
    for number in (None, *arguments.things):
        reports = compare(before, room.visit(1, number))
        gone = [r for r in reports if number is not None and _is(r, room.box_of(number))]
        print("nothing taken" if number is None else f"without {number}", f"reported gone: {len(gone)}", end="; ")
        print("else:", *(f"{r.kind} {r.title}" for r in reports if r not in gone), flush=True)


def _is(report: Report, box: Float64) -> bool:
    return report.kind == "gone" and report.before is not None and near(report.before, box)


if __name__ == "__main__":
    main()
