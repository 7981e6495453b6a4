"""Fusions that need this package: ours, and Open3D's."""

from __future__ import annotations

# Open3D comes without types.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import numpy as np

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.geometry import invert_pose
from semantic_mapper.labels import make_label_set
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.replay.peers.worker import Frame, Peer, Setup
from semantic_mapper.types import CameraIntrinsics, Float32, Int32, PosedFrame

COARSE = (120, 160)  # size of the rendered view that is upsampled, as the pipeline has it


def make_setup(k: CameraIntrinsics, config: VoxelMapConfig) -> Setup:
    """What a camera and settings of the map say."""
    voxel_m = config.voxel_size_m
    return Setup(
        k.fx, k.fy, k.cx, k.cy, k.width, k.height, voxel_m, config.truncation_voxels * voxel_m, config.depth_max_m
    )


def ours(setup: Setup, classes: int = 1) -> Peer:
    """Ours with depth and colour alone, or with class evidence as well."""
    k = CameraIntrinsics(setup.fx, setup.fy, setup.cx, setup.cy, setup.width, setup.height)
    config = VoxelMapConfig(voxel_size_m=setup.voxel_size_m, depth_max_m=setup.depth_max_m)
    voxel_map = VoxelMap(config, make_label_set("bench", [f"class {c}" for c in range(classes)]))
    votes, rows = some_votes(classes, (k.height, k.width)) if classes > 1 else (None, None)

    def prepare(frame: Frame) -> PosedFrame:
        stamp_ns, rgb, depth_m, T_world_camera = frame
        return PosedFrame(int(stamp_ns), 0, "camera", rgb, depth_m, None, k, T_world_camera, "log")

    return Peer(lambda f: voxel_map.integrate(f, f.depth_m, votes, rows=rows), lambda: voxel_map.points().xyz, prepare)


def ours_with_classes(setup: Setup) -> Peer:
    """Ours with 20 classes."""
    return ours(setup, 20)


def open3d(setup: Setup) -> Peer:
    """Open3D's VoxelBlockGrid."""
    grid = Open3DFusion(setup)
    return Peer(grid.add, grid.points)


class Open3DFusion:
    """Open3D's own fusion of TSDF and colour, with its own choice of blocks."""

    def __init__(self, setup: Setup) -> None:
        self._setup, self._o3d = setup, load_open3d()
        core, blocks = self._o3d.core, VoxelMapConfig.initial_blocks
        dtypes, shapes, cpu = (core.float32,) * 3, ((1,), (1,), (3,)), core.Device("CPU:0")
        names = ("tsdf", "weight", "color")
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(names, dtypes, shapes, setup.voxel_size_m, 8, blocks, cpu)
        # Open3D puts pixel centres at halves.
        self._K = core.Tensor(np.array([[setup.fx, 0, setup.cx + 0.5], [0, setup.fy, setup.cy + 0.5], [0, 0, 1]]))

    @property
    def block_count(self) -> int:
        """Blocks of 8^3 voxels in the map."""
        return int(self._grid.hashmap().size())

    def add(self, frame: Frame | PosedFrame) -> None:
        """Fuse a frame, whose depth is float32."""
        core, image, K, setup = self._o3d.core, self._o3d.t.geometry.Image, self._K, self._setup
        T_camera_world = core.Tensor(invert_pose(frame.T_world_camera))
        depth = image(core.Tensor.from_numpy(frame.depth_m))
        color = image(core.Tensor.from_numpy(frame.rgb.astype(np.float32)))
        limits = (1.0, setup.depth_max_m, setup.truncation_m / setup.voxel_size_m)
        blocks = self._grid.compute_unique_block_coordinates(depth, K, T_camera_world, *limits)
        self._grid.integrate(blocks, depth, color, K, K, T_camera_world, *limits)

    def points(self) -> Float32:
        """(N, 3) metres on the surface."""
        return self._grid.extract_point_cloud(weight_threshold=0.5).point.positions.numpy()


def some_votes(classes: int, size: tuple[int, int]) -> tuple[Float32, Int32]:
    """Class probabilities (h * w, L) of a coarse view, patches of 10 x 10 pixels of one class each, as sure as a field
    is, and which of them (H, W) int32 each pixel of a frame of this size takes: the coarse one that it lies in."""
    patch = np.random.default_rng(0).integers(0, classes, (COARSE[0] // 10, COARSE[1] // 10))
    sure = np.eye(classes, dtype=np.float32)[np.repeat(np.repeat(patch, 10, 0), 10, 1)]
    probabilities = np.ascontiguousarray(0.9 * sure + np.float32(0.1 / classes)).reshape(-1, classes)
    rows, columns = (np.arange(n) * coarse // n for n, coarse in zip(size, COARSE, strict=True))
    return probabilities, (rows[:, None] * COARSE[1] + columns).astype(np.int32)
