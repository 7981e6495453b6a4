"""Frames kept with all that may tell the map of their classes, so that maps of other rules are fused in seconds.

python -m research.experiments.kept_votes DIR val test kitchen=LOG flat=LOG [--segmenter TABLE] [--rooms N]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from research.evaluation.points import nearest_labels
from research.evaluation.room_map import NEAR_M, true_surface
from research.scenes import CameraPathConfig, NoiseConfig, RoomConfig, make_room, room_frames
from research.suites.config import MAP_WIDTH, SequenceConfig, SuiteConfig, camera_of_width, suite_seeds
from research.suites.rooms import as_given
from semantic_mapper.config import MapperConfig, SegmenterConfig, VoxelMapConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.base import Encoded
from semantic_mapper.fields.weights import default_checkpoint_path, load_weights
from semantic_mapper.geometry import scale_intrinsics
from semantic_mapper.imaging import FrameViews
from semantic_mapper.labels import ROOMS, LabelSet, make_label_set
from semantic_mapper.mapper import Mapper, make_field
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.mapping.rendering import RenderedView, upsample
from semantic_mapper.mapping.segmenter import Opinion, Segmenter
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.truth import SurfaceTruth, TruthMapper
from semantic_mapper.replay.log.sequence import open_log
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Int32, PosedFrame, UInt8

CONFIG = MapperConfig(voxel_map=VoxelMapConfig(unknown_below=0.0))


class Kept(NamedTuple):
    """A frame as it was fused, and what was said of it at its coarse pixels (h, w)."""

    frame: PosedFrame  # without depth where something moves; labels (H, W) are ids of the map
    labelled: Bool  # (H, W) where the recording has a class, be it one that the map lacks
    known: Bool
    rendered: Float32  # (h, w, L) from eight views, its own among them
    single: Float32  # (h, w, L) from its own alone
    own: Float32  # (h, w, L) logits of its image
    asked: Float32  # (a, b, K) what the segmenter makes of it, or (0, 0, 0)

    @property
    def coarse(self) -> CameraIntrinsics:
        """Of the pixels (h, w)."""
        return scale_intrinsics(self.frame.intrinsics, self.known.shape[1], self.known.shape[0])


class Recording(NamedTuple):
    """Frames of a room or a log; its truth at points (N, 3): ids of the map, and whether there is a class at all."""

    name: str
    label_set: LabelSet
    frames: list[Kept]
    truth: Callable[[Float32], tuple[UInt8, Bool]]


Rule = Callable[[Kept, VoxelMap], Float32]  # the votes (h, w, L) of a frame, in view of the map so far


def fuse(recording: Recording, rule: Rule) -> tuple[VoxelMap, list[Int32]]:
    """The map of a rule's votes, and which coarse pixel each pixel of the frames takes."""
    voxel_map, rows = VoxelMap(CONFIG.voxel_map, recording.label_set), list[Int32]()
    for kept in recording.frames:
        votes, views, low = np.ascontiguousarray(rule(kept, voxel_map)), FrameViews(kept.frame), kept.coarse
        depth = kept.frame.depth_m
        assert depth is not None
        rows.append(upsample(votes, kept.known, views.rgb(low), views.depth(low), kept.frame.rgb, depth))
        table = votes.reshape(-1, votes.shape[2])
        voxel_map.integrate(kept.frame, depth, table, rows=rows[-1], measured=True)
    return voxel_map, rows


def true_points(recording: Recording, points: MapPoints) -> tuple[UInt8, Bool]:
    """Of the points of a map: true ids, and which of them count, having a vote and a true class."""
    truth, labelled = recording.truth(points.xyz)
    return truth, labelled & (points.confidence > 0)


class _Keeping(MappingPipeline):
    """Keeps what each frame was fused with."""

    said: tuple[RenderedView, RenderedView, Float32]
    fused: PosedFrame

    def _render_semantics(
        self, views: FrameViews, sources: Any, current: Encoded, opinion: Opinion | None
    ) -> tuple[RenderedView, RenderedView]:
        pair = super()._render_semantics(views, sources, current, opinion)
        scale = self.config.render.scale
        rendered = self._render(views, self._with_own(sources, current), scale, self._renderer)
        single = self._render(views, [current], scale, self._renderer)
        own = self.field.source_logits(current)
        assert own is not None
        height, width = single.known.shape
        own = np.asarray(cv2.resize(own, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
        self.said = rendered, single, own
        return pair

    def _keep_view(self, views: FrameViews, current: Encoded, sources: Any) -> bool:
        self.fused = views.frame
        return super()._keep_view(views, current, sources)


class _Asking(Segmenter):
    """A segmenter whose model may be asked without anything else."""

    def outputs(self, rgb: UInt8) -> Float32:
        """(a, b, K) of an image (H, W, 3)."""
        return self._model.run(self._prepared(rgb))


def keep(path: Path, frames: Iterable[PosedFrame], labels: LabelSet, table: str, **more: NDArray[Any]) -> None:
    """Map frames with labels, and write what was said of them; ``more`` is the true surface, where it is known."""
    mapper = Mapper.load(None, CONFIG)
    asking = _Asking(SegmenterConfig(table=table), mapper.label_set) if table else None
    config = mapper.pipeline.config
    pipeline = _Keeping(config, make_field(mapper.weights, config), mapper.label_set)
    kept: dict[str, list[Any]] = {name: [] for name in _ARRAYS}
    for frame in frames:
        try:
            (ready,) = pipeline.prepare(frame)
            pipeline.step(ready)
        except FrameError:
            continue
        rendered, single, own = pipeline.said
        k = frame.intrinsics
        asked = asking.outputs(frame.rgb) if asking else np.zeros((0, 0, 0))
        values = (
            frame.rgb,
            pipeline.fused.depth_m,
            frame.label,
            frame.T_world_camera,
            (k.fx, k.fy, k.cx, k.cy, k.width, k.height),
            rendered.known,
            *(p.astype(np.float16) for p in (rendered.probabilities, single.probabilities, own, asked)),
        )
        for name, value in zip(_ARRAYS, values, strict=True):
            kept[name].append(value)
    arrays = {name: np.stack(v) for name, v in kept.items()} | more
    arrays |= {"stream_ids": np.array(labels.ids), "stream_names": np.array(labels.names)}
    np.savez(path, allow_pickle=False, **arrays, stream_ignore=np.array(labels.ignore_id))


_IMAGES = ("rgb", "depth", "label", "pose", "intrinsics")
_SAID = ("known", "rendered", "single", "own", "asked")
_ARRAYS = (*_IMAGES, *_SAID)


def frames_of(path: Path, target: LabelSet, every: int = 1) -> list[PosedFrame]:
    """Frames of a file of ``keep`` with ids of ``target``, without what was said of them."""
    with np.load(path) as file:
        to_map, images = TruthMapper(_stream(path, file), target), (file[name][::every] for name in _IMAGES)
        return [
            PosedFrame(i, i, "camera", rgb, depth, to_map.to_map_ids(label, path.stem), _intrinsics(k), pose)
            for i, (rgb, depth, label, pose, k) in enumerate(zip(*images, strict=True))
        ]


def _stream(path: Path, file: Mapping[str, NDArray[Any]]) -> LabelSet:
    names, ids = [str(n) for n in file["stream_names"]], [int(i) for i in file["stream_ids"]]
    return make_label_set(path.stem, names, ids=ids, ignore_id=int(file["stream_ignore"]))


def _intrinsics(k: NDArray[Any]) -> CameraIntrinsics:
    return CameraIntrinsics(*map(float, k[:4]), width=int(k[4]), height=int(k[5]))


def load(path: Path, every: int = 1) -> Recording:
    """What ``keep`` wrote, of every so many-th frame."""
    target = load_weights(default_checkpoint_path()).label_set
    with np.load(path) as file:
        stream = _stream(path, file)
        labels, *said = (file[name][::every] for name in ("label", *_SAID))
        points = (file["xyz"], file["surface"]) if "xyz" in file else None
    to_map, surface, frames = TruthMapper(stream, target), SurfaceTruth(stream), list[Kept]()
    for frame, label, known, *of in zip(frames_of(path, target, every), labels, *said, strict=True):
        surface.add(replace(frame, label=label))
        frames.append(Kept(frame, label != stream.ignore_id, known, *(p.astype(np.float32) for p in of)))

    def truth(xyz: Float32) -> tuple[UInt8, Bool]:
        labels = nearest_labels(xyz, *points, stream, max_distance_m=NEAR_M) if points else surface.labels_at(xyz)
        return to_map.to_map_ids(labels, path.stem), labels != stream.ignore_id

    return Recording(path.stem, target, frames, truth)


def load_all(folder: Path, kind: str) -> Iterator[Recording]:
    """Recordings of a folder whose names begin with ``kind``, one at a time."""
    paths = sorted(folder.glob(f"{kind}*.npz"))
    assert paths, f"{folder} has no recordings of '{kind}'; run research.experiments.kept_votes first"
    yield from map(load, paths)


def _keep_room(seed: int, suite: SuiteConfig, path: Path, table: str) -> None:
    camera, furnished = camera_of_width(MAP_WIDTH), RoomConfig(camouflage=SequenceConfig().camouflage)
    way = CameraPathConfig(step_m=suite.sequence.step_m)
    frames = list(room_frames(seed, suite.map_frames, camera, room=furnished, path=way, noise=NoiseConfig()))
    true = true_surface(make_room(seed, furnished), [frame.T_world_camera for frame in frames])
    given = (as_given(frame, depth=True, label=True) for frame in frames)
    keep(path, given, ROOMS, table, xyz=true.xyz, surface=true.label)


def main() -> None:
    """Keep what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sources", nargs="+", help="val, test (rooms), or NAME=LOG")
    parser.add_argument("--segmenter", default="", metavar="TABLE")
    parser.add_argument("--rooms", type=int, default=20)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for source in given.sources:
        name, _, log_path = source.partition("=")
        if log_path:
            with open_log(Path(log_path)) as log:
                assert log.info.label_set is not None, "a log without labels"
                keep(given.folder / f"{name}.npz", log, log.info.label_set, given.segmenter)
            continue
        suite = SuiteConfig(split=name)
        for seed in islice(suite_seeds(suite), given.rooms):
            path = given.folder / f"{name}-{seed}.npz"
            if not path.is_file():
                _keep_room(seed, suite, path, given.segmenter)
                print(path, flush=True)


if __name__ == "__main__":
    main()
