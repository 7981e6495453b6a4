"""Things of a map and of other methods against frames whose objects are known."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import scipy  # loads `spatial` when it is first used
import torch
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import LabelError, LogError
from semantic_mapper.evaluation.metrics import ConfusionMatrix
from semantic_mapper.evaluation.panoptic import PanopticCounts, PanopticImage
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.imaging import resize_label, working_intrinsics
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapView
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.snapshot import MapMirror
from semantic_mapper.queries.surface import surface_voxels
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.replay.evaluate.truth import TRUTH_WIDTH
from semantic_mapper.replay.importers.base import BadFrameError, read_plane
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

RAYS = 4096  # rendered at once
AT_SURFACE = 2.0  # voxels that a pixel of the map's surface is from a surface voxel at most
SEEN = "map seen from frames"  # the method whose figures are those of the finished map, cast into its frames
MAX_FRAMES = 100  # that are kept; beyond that every second one goes


class ThingSurface:
    """The N surface voxels of a map as it is now, ``xyz`` (N, 3) in world metres, its ``things``, unsure ones, too, and
    the ``number`` (N,) of the thing of each voxel, -1 = none. MapError where lengths are not metres."""

    def __init__(self, voxel_map: VoxelMap, *, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        snapshot = MapMirror.of(voxel_map).snapshot()
        every = surface_voxels(snapshot)
        keys = (every.row.astype(np.int64) << 9) | every.voxel  # ascending
        self.things, voxels, number = InstanceTracker(up=up).find(snapshot)
        self.number: NDArray[np.int64] = np.full(len(keys), -1, np.int64)
        self.number[np.searchsorted(keys, (voxels.row.astype(np.int64) << 9) | voxels.voxel)] = number
        self.xyz: Float64 = every.point * snapshot.voxel_size_m
        self._reach_m = AT_SURFACE * snapshot.voxel_size_m

    def panoptic(self, cast: MapView, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> PanopticImage:
        """Classes and things, numbered from 1, that a view of the map shows: what ``ray_cast`` gives for a pose and
        intrinsics, but where there is a thing."""
        label, instance = cast.label.copy(), np.zeros(cast.label.shape, np.int64)
        hit = cast.depth_m > 0
        if self.things and hit.any():
            at = transform(T_world_camera, unproject(cast.depth_m, intrinsics)[hit])
            _, near = self._tree.query(at, distance_upper_bound=self._reach_m)
            number = np.append(self.number, -1)[near]
            class_of = np.array([thing.class_id for thing in self.things], np.uint8)
            instance[hit] = number + 1
            label[hit] = np.where(number >= 0, class_of[number], label[hit])
        return PanopticImage(label, instance)

    @cached_property
    def _tree(self) -> Any:
        return scipy.spatial.KDTree(self.xyz)


class _View(NamedTuple):
    T_world_camera: Float64
    intrinsics: CameraIntrinsics
    truth: PanopticImage
    found: Mapping[str, PanopticImage]


class PanopticTruth:
    """True classes, ids of the map's ``label_set``, and objects of some frames of a log.

    Object numbers are images in a folder, uint8 or uint16, 0 = none: ``NNNNNN.png`` or ``CAMERA/NNNNNN.png``, by the
    number of the frame in the log, from 0. Segments that are found of classes that the frames' ``stream_labels`` lack
    are as if nothing had been found. Raises LabelError: the folder holds no image.
    """

    def __init__(self, folder: Path, log: Log, stream_labels: LabelSet, label_set: LabelSet) -> None:
        self._folder = folder
        parts = enumerate(log.frame_parts())
        self._number = {(envelope.source, envelope.stamp_ns): number for number, (envelope, _) in parts}
        if not any(folder.glob("*.png")) and not any(folder.glob("*/*.png")):
            raise LabelError(
                f"{folder}: has no images of objects; they are called by the number of their frame, 000012.png"
            )
        self._label_set = label_set
        shared = [i for i, name in zip(label_set.ids, label_set.names, strict=True) if name in stream_labels.names]
        self._shared = np.full(256, label_set.ignore_id, np.uint8)
        self._shared[shared] = shared
        self._views: list[_View] = []
        self._stride = 1
        self._seen = 0

    def add(self, frame: PosedFrame, truth: UInt8, found: Mapping[str, Callable[[], PanopticImage]] = {}) -> None:
        """Remember a frame whose objects are known, with its truth (H, W), at reduced size.

        ``found`` gives, by method, what it says of the frame (H, W); called where objects are known. Raises LogError:
        the image of its objects is damaged.
        """
        name = f"{self._number[frame.camera_id, frame.stamp_ns]:06d}.png"
        places = self._folder / frame.camera_id / name, self._folder / name
        file = next((place for place in places if place.exists()), None)
        self._seen += 1
        if file is None or (self._seen - 1) % self._stride:
            return
        try:
            instance = read_plane(file, "any", (frame.intrinsics.height, frame.intrinsics.width), "instance")
        except BadFrameError as error:
            raise LogError(str(error)) from error
        k = working_intrinsics(frame.intrinsics, TRUTH_WIDTH)
        said = {name: _resized(ask(), k) for name, ask in found.items()}
        self._views.append(_View(frame.T_world_camera, k, _resized(PanopticImage(truth, instance), k), said))
        if len(self._views) > MAX_FRAMES:
            self._views = self._views[::2]
            self._stride *= 2

    def score_methods(self) -> Mapping[str, Mapping[str, Any]]:
        """The figures of ``PanopticMetrics`` by method of ``add``, of the frames that ``score`` looks at."""
        views = self._known_views()
        counts = {name: PanopticCounts(self._label_set) for name in views[0].found}
        for view in views:
            for name, found in view.found.items():
                counts[name].update(view.truth, self._of_shared(found), name)
        return {name: _figures(of) | {"panoptic_frames": len(views)} for name, of in counts.items()}

    def score(self, voxel_map: VoxelMap) -> Mapping[str, Any]:
        """The figures of ``SegmentationMetrics`` and of ``PanopticMetrics``, whose classes are ``pq_per_class``.

        Raises LabelError: no frame was added. MapError: lengths of the map are not metres.
        """
        views = self._known_views()
        things = ThingSurface(voxel_map)
        matrix, counts = ConfusionMatrix(self._label_set), PanopticCounts(self._label_set)
        for view in views:
            cast = voxel_map.ray_cast(view.T_world_camera, view.intrinsics)
            found = things.panoptic(cast, view.T_world_camera, view.intrinsics)
            matrix.update(view.truth.label, found.label, SEEN)
            counts.update(view.truth, self._of_shared(found), SEEN)
        return asdict(matrix.metrics()) | _figures(counts) | {"panoptic_frames": len(views)}

    def _known_views(self) -> list[_View]:
        if not self._views:
            raise LabelError(f"{self._folder}: has no image of any frame that is scored")
        return self._views

    def _of_shared(self, found: PanopticImage) -> PanopticImage:
        return found._replace(label=self._shared[found.label])


def _resized(image: PanopticImage, intrinsics: CameraIntrinsics) -> PanopticImage:
    size = (intrinsics.width, intrinsics.height)
    instance = cv2.resize(np.asarray(image.instance, np.uint16), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return PanopticImage(resize_label(image.label, intrinsics), np.asarray(instance, np.uint16))


def _figures(counts: PanopticCounts) -> dict[str, Any]:
    figures = asdict(counts.metrics())
    figures["pq_per_class"] = figures.pop("per_class")
    return figures


def thing_image(field: Panoptic, frame: PosedFrame, label: UInt8) -> PanopticImage:
    """The boxes of things, by their ids, that a frame sees where its ``label`` (H, W) has their class."""
    channel = field.label_set.to_channels(label, f"frame seq={frame.seq}").ravel()
    names = field.label_set.names
    boxed = [names.index(b.class_name) for b in field.shape.boxes if b.thing]
    requested = torch.from_numpy(np.flatnonzero(np.isin(channel, boxed)))
    k, found = frame.intrinsics, np.zeros(label.size, np.uint16)
    depth = np.zeros(label.size, np.float32) if frame.depth_m is None else frame.depth_m.ravel()
    pose = torch.from_numpy(frame.T_world_camera).float()
    pixels, near_m = pixel_grid(k.width, k.height), field.sampling.near_m
    with torch.no_grad():
        for part in requested.split(RAYS):
            prior = torch.from_numpy(depth[part.numpy()])
            at = {"near_m": near_m, "far_m": field.sampling.far_m, "stamp_ns": frame.stamp_ns}
            rays = pixel_rays(pixels[part], k, pose, **at, prior_depth_m=prior)
            found[part.numpy()] = field.instances(rays, torch.from_numpy(channel[part.numpy()])).numpy()
    return PanopticImage(label, found.reshape(label.shape))
