"""Ground truth in the classes of the map: per frame by class name, and per surface point by majority of the frames."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.imaging import resize_depth, resize_label, working_intrinsics
from semantic_mapper.labels import IGNORE_CHANNEL, LabelSet
from semantic_mapper.transport.images import DepthSpec, Uint8Spec, encode_depth, encode_uint8
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8

TRUTH_WIDTH = 320
DEPTH_SCALE = 1000.0  # units a metre that depth is packed in where that is exact
MAX_FRAMES = 400  # frames whose truth is kept; beyond that every second one goes
AGREEMENT_M = 0.04  # a frame votes on a surface point only where its depth is this near to it


class TruthMapper:
    """Translates label ids of a stream to those of the map by class name; classes that the map lacks are ignored."""

    def __init__(self, stream: LabelSet, target: LabelSet) -> None:
        self._stream = stream
        self._table = target.to_ids(target.channel_map_from(stream))
        self.shared = tuple(n for n in stream.names if n in target.names)

    def to_map_ids(self, label: UInt8, where: str) -> UInt8:
        """Label image in ids of the map. Raises LabelError: an id that the stream's own label set does not know."""
        self._stream.to_channels(label, where)
        return self._table[label]


class _TruthView(NamedTuple):
    camera_id: str
    stamp_ns: int
    T_world_camera: Float64
    intrinsics: CameraIntrinsics
    depth: tuple[DepthSpec, bytes]
    label: tuple[Uint8Spec, bytes]


class SurfaceTruth:
    """Truth labels of map points: each labelled frame that sees a point votes, the majority wins."""

    def __init__(self, label_set: LabelSet) -> None:
        self._label_set = label_set
        self._frames: list[_TruthView] = []
        self._stride = 1
        self._seen = 0

    def add(self, frame: PosedFrame) -> None:
        """Remember what a labelled frame (ids of the map's label set) says, at reduced size."""
        if frame.label is None or frame.depth_m is None:
            return
        if self._seen % self._stride == 0:
            k = working_intrinsics(frame.intrinsics, TRUTH_WIDTH)
            depth, label = resize_depth(frame, k), resize_label(frame.label, k)
            packed = encode_depth(depth, DEPTH_SCALE), encode_uint8(label)
            self._frames.append(_TruthView(frame.camera_id, frame.stamp_ns, frame.T_world_camera, k, *packed))
        self._seen += 1
        if len(self._frames) > MAX_FRAMES:
            self._frames = self._frames[::2]
            self._stride *= 2

    def move(self, poses: Mapping[tuple[str, int], Float64]) -> None:
        """Take frames to corrected poses, (camera_id, stamp_ns) -> T_world_camera; those not named stay."""
        self._frames = [
            view._replace(T_world_camera=poses.get((view.camera_id, view.stamp_ns), view.T_world_camera))
            for view in self._frames
        ]

    def labels_at(self, xyz: Float32) -> UInt8:
        """Truth ids (N,) of world points (N, 3); the ignore id where no labelled frame saw the point."""
        votes = np.zeros((len(xyz), len(self._label_set)), np.uint16)
        points = xyz.astype(np.float64)
        for view in self._frames:
            p = transform(invert_pose(view.T_world_camera), points)
            inside, row, column = nearest_pixels(p, view.intrinsics)
            size = view.intrinsics.height, view.intrinsics.width
            (depth, packed_depth), (label, packed_label) = view.depth, view.label
            measured = depth.decode(packed_depth, size, "depth")[row, column]
            visible = inside & (measured > 0) & (np.abs(measured - p[:, 2]) < AGREEMENT_M)
            channel = self._label_set.to_channels(label.decode(packed_label, size, "label"))[row, column]
            index = np.flatnonzero(visible & (channel != IGNORE_CHANNEL))
            votes[index, channel[index]] += 1
        channel = np.where(votes.any(axis=1), votes.argmax(axis=1), IGNORE_CHANNEL)
        return self._label_set.to_ids(channel)
