"""Frames whose objects are known, and the finished map with its things as those frames see it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import LabelError, LogError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticImage
from semantic_mapper.imaging import resize_label, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.evaluate.thing_surface import ThingSurface
from semantic_mapper.replay.evaluate.truth import TRUTH_WIDTH
from semantic_mapper.replay.importers.base import BadFrameError, read_plane
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

SEEN = "map seen from frames"  # the method whose figures are those of the finished map, cast into its frames
MAX_FRAMES = 100  # that are kept; beyond that every second one goes


class InstanceFolder:
    """Images of object numbers of a log's frames: ``NNNNNN.png`` or ``CAMERA/NNNNNN.png``, uint8 or uint16, 0 = none.

    NNNNNN is the number of the frame in the log, from 0.

    Args:
        path: Of the folder.
        log: Whose frames they are of.

    Raises:
        LabelError: it holds none.
    """

    def __init__(self, path: Path, log: Log) -> None:
        self.path = path
        parts = enumerate(log.frame_parts())
        self._number = {(envelope.source, envelope.stamp_ns): number for number, (envelope, _) in parts}
        if not any(path.glob("*.png")) and not any(path.glob("*/*.png")):
            raise LabelError(
                f"{path}: has no images of objects; they are called by the number of their frame in the log, 000012.png"
            )

    def read(self, frame: PosedFrame) -> NDArray[np.integer[Any]] | None:
        """Object numbers (H, W) of a frame; None where there is no image of it.

        Raises:
            LogError: it is damaged, or of another size.
        """
        name = f"{self._number[frame.camera_id, frame.stamp_ns]:06d}.png"
        file = next((f for f in (self.path / frame.camera_id / name, self.path / name) if f.exists()), None)
        if file is None:
            return None
        try:
            return read_plane(file, "any", (frame.intrinsics.height, frame.intrinsics.width), "instance")
        except BadFrameError as error:
            raise LogError(str(error)) from error


class _View(NamedTuple):
    T_world_camera: Float64
    intrinsics: CameraIntrinsics
    truth: PanopticImage


class PanopticTruth:
    """True classes and objects of some frames.

    Args:
        folder: Has the objects.
        stream_labels: Of the frames. Segments that the map finds of other classes are as if nothing had been found.
        label_set: Of the map, and of the true classes that are added.
    """

    def __init__(self, folder: InstanceFolder, stream_labels: LabelSet, label_set: LabelSet) -> None:
        self._folder = folder
        self._label_set = label_set
        shared = [i for i, name in zip(label_set.ids, label_set.names, strict=True) if name in stream_labels.names]
        self._shared = np.full(256, label_set.ignore_id, np.uint8)
        self._shared[shared] = shared
        self._views: list[_View] = []
        self._stride = 1
        self._seen = 0

    def add(self, frame: PosedFrame, truth: UInt8) -> None:
        """Remember a frame whose objects are known, at reduced size; ``truth`` (H, W) are ids of the map.

        Raises:
            LogError: see ``InstanceFolder.read``.
        """
        instance = self._folder.read(frame) if self._seen % self._stride == 0 else None
        self._seen += 1
        if instance is None:
            return
        k = working_intrinsics(frame.intrinsics, TRUTH_WIDTH)
        size = (k.width, k.height)
        small = np.asarray(cv2.resize(instance, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
        self._views.append(_View(frame.T_world_camera, k, PanopticImage(resize_label(truth, k), small)))
        if len(self._views) > MAX_FRAMES:
            self._views = self._views[::2]
            self._stride *= 2

    def score(self, voxel_map: VoxelMap) -> Mapping[str, Any]:
        """The figures of ``SegmentationMetrics`` and of ``PanopticMetrics``, whose classes are ``pq_per_class``.

        Raises:
            LabelError: no frame was added.
            MapError: lengths of the map are not metres.
        """
        if not self._views:
            raise LabelError(f"{self._folder.path}: has no image of any frame that is scored")
        things = ThingSurface(voxel_map)
        matrix, counts = ConfusionMatrix(self._label_set), PanopticCounts(self._label_set)
        for view in self._views:
            cast = voxel_map.ray_cast(view.T_world_camera, view.intrinsics)
            found = things.panoptic(cast, view.T_world_camera, view.intrinsics)
            matrix.update(view.truth.label, found.label, SEEN)
            counts.update(view.truth, found._replace(label=self._shared[found.label]), SEEN)
        panoptic = asdict(counts.metrics())
        panoptic["pq_per_class"] = panoptic.pop("per_class")
        return asdict(matrix.metrics()) | panoptic | {"panoptic_frames": len(self._views)}
