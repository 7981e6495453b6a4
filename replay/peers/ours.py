"""Our own fusion and odometry, and Open3D's, as peers of each other."""

from __future__ import annotations

# Open3D comes without types.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from typing import Any

import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.peers.worker import Frame, Peer, Setup
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32, PosedFrame

COARSE = (120, 160)  # size of the rendered view that is upsampled, as the pipeline has it


def make_setup(k: CameraIntrinsics, config: VoxelMapConfig) -> Setup:
    """What a camera and settings of the map say."""
    voxel_m = config.voxel_size_m
    return Setup(
        k.fx, k.fy, k.cx, k.cy, k.width, k.height, voxel_m, config.truncation_voxels * voxel_m, config.depth_max_m
    )


class Fusion(Peer):
    """Ours with depth and colour alone."""

    classes = 1

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        k = self.intrinsics = CameraIntrinsics(setup.fx, setup.fy, setup.cx, setup.cy, setup.width, setup.height)
        config = VoxelMapConfig(voxel_size_m=setup.voxel_size_m, depth_max_m=setup.depth_max_m)
        self._map = VoxelMap(config, make_label_set("bench", [f"class {c}" for c in range(self.classes)]))
        self._votes, self._rows = some_votes(self.classes, (k.height, k.width)) if self.classes > 1 else (None, None)

    def prepare(self, frame: Frame) -> PosedFrame:
        of_camera = None, self.intrinsics, frame.T_world_camera
        return PosedFrame(int(frame.stamp_ns), 0, "camera", frame.rgb, frame.depth_m, *of_camera, "log")

    def add(self, prepared: Any) -> None:
        self._map.integrate(prepared, prepared.depth_m, self._votes, rows=self._rows)

    def points(self) -> Float32:
        return self._map.points().xyz


class SemanticFusion(Fusion):
    """Ours with class evidence as well."""

    classes = 20


class Open3DFusion(Peer):
    """Open3D's own fusion of TSDF and colour, with its own choice of blocks."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._o3d = load_open3d()
        core, blocks = self._o3d.core, VoxelMapConfig.initial_blocks
        dtypes, shapes, cpu = (core.float32,) * 3, ((1,), (1,), (3,)), core.Device("CPU:0")
        names = ("tsdf", "weight", "color")
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(names, dtypes, shapes, setup.voxel_size_m, 8, blocks, cpu)
        self._K = _matrix(core, setup, 0.5)

    @property
    def block_count(self) -> int:
        """Blocks of 8^3 voxels in the map."""
        return int(self._grid.hashmap().size())

    def add(self, prepared: Frame | PosedFrame) -> None:
        core, image, K, setup = self._o3d.core, self._o3d.t.geometry.Image, self._K, self.setup
        T_camera_world = core.Tensor(invert_pose(prepared.T_world_camera))
        depth = image(core.Tensor.from_numpy(prepared.depth_m))
        color = image(core.Tensor.from_numpy(prepared.rgb.astype(np.float32)))
        limits = (1.0, setup.depth_max_m, setup.truncation_m / setup.voxel_size_m)
        blocks = self._grid.compute_unique_block_coordinates(depth, K, T_camera_world, *limits)
        self._grid.integrate(blocks, depth, color, K, K, T_camera_world, *limits)

    def points(self) -> Float32:
        return self._grid.extract_point_cloud(weight_threshold=0.5).point.positions.numpy()


class Odometry(Peer):
    """Ours, without closing loops: its poses as they come."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._intrinsics = CameraIntrinsics(setup.fx, setup.fy, setup.cx, setup.cy, setup.width, setup.height)
        self._source = OdometryPoseSource(OdometryPoses(loop_closure=False))

    def prepare(self, frame: Frame) -> CameraImage:
        return CameraImage(int(frame.stamp_ns), 0, "camera", frame.rgb, frame.depth_m, self._intrinsics)

    def add(self, prepared: Any) -> Float64 | None:
        found = self._source.pose(prepared)
        return None if found is None else found.T_world_camera


class Open3DOdometry(Peer):
    """Frame to frame, point to plane, the last motion continued."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._o3d = load_open3d()
        self._K = _matrix(self._o3d.core, setup, 0.0)
        self._before: Any = None
        self._pose = self._motion = np.eye(4)

    def add(self, prepared: Frame) -> Float64:
        odometry, geometry, core = self._o3d.t.pipelines.odometry, self._o3d.t.geometry, self._o3d.core
        images = geometry.Image(prepared.rgb), geometry.Image(prepared.depth_m)
        now, steps = geometry.RGBDImage(*images), [odometry.OdometryConvergenceCriteria(n) for n in (10, 5, 3)]
        if self._before is not None:
            guess, options = (
                core.Tensor(self._motion),
                (1.0, self.setup.depth_max_m, steps, odometry.Method.PointToPlane),
            )
            result = odometry.rgbd_odometry_multi_scale(now, self._before, self._K, guess, *options)
            self._motion = result.transformation.numpy()
            self._pose = self._pose @ self._motion
        self._before = now
        return self._pose


def _matrix(core: Any, setup: Setup, center: float) -> Any:
    """(3, 3) tensor, where pixel centres are at integers plus ``center``."""
    return core.Tensor(np.array([[setup.fx, 0, setup.cx + center], [0, setup.fy, setup.cy + center], [0, 0, 1]]))


def some_votes(classes: int, size: tuple[int, int]) -> tuple[Float32, Int32]:
    """Class probabilities (h * w, L) of a coarse view, patches of 10 x 10 pixels of one class each, as sure as a field
    is, and which of them (H, W) int32 each pixel of a frame of this size takes: the coarse one that it lies in."""
    patch = np.random.default_rng(0).integers(0, classes, (COARSE[0] // 10, COARSE[1] // 10))
    sure = np.eye(classes, dtype=np.float32)[np.repeat(np.repeat(patch, 10, 0), 10, 1)]
    probabilities = np.ascontiguousarray(0.9 * sure + np.float32(0.1 / classes)).reshape(-1, classes)
    rows, columns = (np.arange(n) * coarse // n for n, coarse in zip(size, COARSE, strict=True))
    return probabilities, (rows[:, None] * COARSE[1] + columns).astype(np.int32)
