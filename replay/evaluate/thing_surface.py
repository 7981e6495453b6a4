"""Which thing of a map a surface belongs to: at its voxels, and in the pixels of a view of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.evaluation.panoptic import PanopticImage
from semantic_mapper.geometry import transform, unproject
from semantic_mapper.mapping.blocks import pack_keys
from semantic_mapper.mapping.map_types import MapView
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.memory import check_room_for_scipy
from semantic_mapper.queries.instances import InstanceTracker
from semantic_mapper.queries.mirror import MapMirror
from semantic_mapper.queries.surface import class_surface
from semantic_mapper.types import CameraIntrinsics, Float64

AT_SURFACE = 2.0  # voxels that a pixel of the map's surface is from a surface voxel at most


class ThingSurface:
    """The N surface voxels of a map as it is now.

    Args:
        voxel_map: Whose.
        up: As of ``InstanceTracker``.

    Attributes:
        xyz: (N, 3) float64 surface points, world metres.
        number: (N,) which of ``things`` each belongs to; -1 = none.
        things: As queries find them.

    Raises:
        MapError: lengths of the map are not metres.
    """

    def __init__(self, voxel_map: VoxelMap, *, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        snapshot = MapMirror.of(voxel_map).snapshot()
        every = class_surface(snapshot, np.ones(256, np.bool_))
        row = np.repeat(np.arange(len(every.packed)), np.diff(every.start))
        keys = (row << 9) | every.voxel  # ascending
        self.things = InstanceTracker(up=up).update(snapshot)
        self.number: NDArray[np.int64] = np.full(len(keys), -1, np.int64)
        for index, thing in enumerate(self.things):
            block = np.searchsorted(every.packed, pack_keys(thing.voxels >> 3))
            x, y, z = (thing.voxels & 7).T
            self.number[np.searchsorted(keys, (block << 9) | (z * 64 + y * 8 + x))] = index
        self.xyz: Float64 = every.point * snapshot.voxel_size_m
        self._reach_m = AT_SURFACE * snapshot.voxel_size_m
        self._label_set = voxel_map.label_set
        self._tree: Any = None

    def panoptic(self, cast: MapView, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> PanopticImage:
        """Classes and things that a view of the map shows.

        Args:
            cast: What ``ray_cast`` returns for the pose and the intrinsics.
            T_world_camera: (4, 4) float64.
            intrinsics: Of the view.

        Returns:
            Class ids (H, W), those of the view but where there is a thing; and numbers of things from 1, 0 = none.
        """
        label, instance = cast.label.copy(), np.zeros(cast.label.shape, np.int64)
        hit = cast.depth_m > 0
        if self.things and hit.any():
            at = transform(T_world_camera, unproject(cast.depth_m, intrinsics)[hit])
            _, near = self._nearest().query(at, distance_upper_bound=self._reach_m)
            number = np.append(self.number, -1)[near]
            class_of = np.array([thing.class_id for thing in self.things], np.uint8)
            instance[hit] = number + 1
            label[hit] = np.where(number >= 0, class_of[number], label[hit])
        return PanopticImage(label, instance)

    def _nearest(self) -> Any:
        if self._tree is None:
            check_room_for_scipy()
            from scipy.spatial import KDTree

            self._tree = KDTree(self.xyz)
        return self._tree
