"""A peer in a process of its own: ``python worker.py FOLDER JOB``, with the frames in FOLDER and JOB as JSON.

Needs NumPy and the peer alone: VDBFusion has no packages for the Pythons of ours, and runs in an environment of its
own. What ``prepare`` of a peer does, such as points of a depth image, is not timed.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

GHOST_FRAMES = 15  # with the object, and as many without it
GHOST_SIZE = 160, 120
ROOM = np.array([[-2.0, -1.3, -1.0], [2.0, 1.2, 3.5]])  # its lower and upper corner; x right, y down, z ahead, metres
THING = np.array([[-0.3, 0.6, 1.6], [0.3, 1.2, 2.2]])  # stands on the floor


@dataclass(frozen=True)
class Setup:
    """What all peers are given."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    voxel_size_m: float
    truncation_m: float
    depth_max_m: float


class Frame(NamedTuple):
    """A frame as it was decoded."""

    stamp_ns: int
    rgb: Any  # (H, W, 3) uint8
    depth_m: Any  # (H, W) float32 metres, 0 = none
    T_world_camera: Any  # (4, 4) float64


class Peer:
    """A mapper, which gives ``points``, or an odometry, whose ``add`` gives poses."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup

    def prepare(self, frame: Frame) -> Any:
        """What ``add`` takes."""
        return frame

    def add(self, prepared: Any) -> Any:
        """Fuse a frame; of an odometry T_world_camera (4, 4), None while it is lost."""
        raise NotImplementedError

    def points(self) -> Any:
        """(N, 3) metres: the surface."""
        raise NotImplementedError


class OfPoints(Peer):
    """Takes points in the camera's axes."""

    def prepare(self, frame: Frame) -> Any:
        return camera_points(frame, self.setup)


class OfWorldPoints(Peer):
    """Takes points in the world, and where the camera was."""

    def prepare(self, frame: Frame) -> Any:
        T = frame.T_world_camera
        return camera_points(frame, self.setup) @ T[:3, :3].T + T[:3, 3], T[:3, 3].copy()


class OpenCVHashTSDF(Peer):
    """``cv2.Volume`` of OpenCV 5; it fuses depth alone."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        cv2 = import_module("cv2")
        if not hasattr(cv2, "Volume"):
            raise ImportError(f"OpenCV {cv2.__version__} has no Volume")
        cv2.setNumThreads(1)
        settings = cv2.VolumeSettings(cv2.VolumeType_HashTSDF)
        settings.setVoxelSize(setup.voxel_size_m)
        settings.setTsdfTruncateDistance(setup.truncation_m)
        settings.setMaxDepth(setup.depth_max_m)
        settings.setMaxWeight(255)
        settings.setDepthFactor(1.0)
        settings.setIntegrateWidth(setup.width)
        settings.setIntegrateHeight(setup.height)
        K = [[setup.fx, 0, setup.cx], [0, setup.fy, setup.cy], [0, 0, 1]]
        settings.setCameraIntegrateIntrinsics(np.array(K, np.float32))
        settings.setVolumePose(np.eye(4, dtype=np.float32))
        self._volume = cv2.Volume(cv2.VolumeType_HashTSDF, settings)

    def add(self, prepared: Frame) -> None:
        self._volume.integrate(prepared.depth_m, prepared.T_world_camera.astype(np.float32))

    def points(self) -> Any:
        return self._volume.fetchPointsNormals()[0].reshape(-1, 4)[:, :3]


class VDBFusion(OfWorldPoints):
    """Without space carving, as its own examples."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        make = import_module("vdbfusion").VDBVolume
        if int(np.__version__.split(".")[0]) > 1:
            raise ImportError(f"vdbfusion ends in a segmentation fault with NumPy {np.__version__}; it needs numpy<2")
        self._volume = make(setup.voxel_size_m, setup.truncation_m, False)

    def add(self, prepared: Any) -> None:
        self._volume.integrate(*prepared)

    def points(self) -> Any:
        return self._volume.extract_triangle_mesh()[0]


class OctoMap(OfWorldPoints):
    """Rays from each voxel with a measurement (``discretize``); its surface are centres of occupied voxels."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._tree = import_module("pyoctomap").OcTree(setup.voxel_size_m)

    def add(self, prepared: Any) -> None:
        self._tree.insertPointCloud(*prepared, -1.0, False, True)

    def points(self) -> Any:
        return self._tree.extractPointCloud()[0]


class SmallGicp(OfPoints):
    """Scans against a model of Gaussian voxels, the last motion continued."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._gicp = import_module("small_gicp")
        self._model: Any = None
        self._pose = self._motion = np.eye(4)

    def add(self, prepared: Any) -> Any:
        scan, _ = self._gicp.preprocess_points(prepared, 0.05, num_threads=1)
        if self._model is None:
            self._model = self._gicp.GaussianVoxelMap(0.1)
        else:
            near = {"max_correspondence_distance": 0.3, "num_threads": 1}
            pose = self._gicp.align(self._model, scan, self._pose @ self._motion, **near).T_target_source
            self._pose, self._motion = pose, np.linalg.inv(self._pose) @ pose
        self._model.insert(scan, self._pose)
        return self._pose


class KissIcp(OfPoints):
    """Its own settings for this range (voxels of 1 % of it), but for what are no LiDARs: no deskewing."""

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        config = import_module("kiss_icp.config").KISSConfig()
        config.data.max_range, config.data.deskew = setup.depth_max_m, False
        config.mapping.voxel_size = setup.depth_max_m / 100
        config.registration.max_num_threads = 1
        self._odometry = import_module("kiss_icp.kiss_icp").KissICP(config)

    def add(self, prepared: Any) -> Any:
        self._odometry.register_frame(prepared, np.empty(0))
        return self._odometry.last_pose


def camera_points(frame: Frame, setup: Setup) -> Any:
    """(N, 3) float64 in the camera's axes, metres."""
    v, u = np.nonzero(frame.depth_m)
    z = frame.depth_m[v, u].astype(np.float64)
    return np.stack(((u - setup.cx) / setup.fx * z, (v - setup.cy) / setup.fy * z, z), axis=1)


def ghost_frames(setup: Setup) -> tuple[Setup, list[Frame]]:
    """A camera that sways in a room; an object stands in its view for ``GHOST_FRAMES``, then it is gone."""
    width, height = GHOST_SIZE
    setup = replace(setup, fx=width / 1.2, fy=width / 1.2, cx=width / 2, cy=height / 2, width=width, height=height)
    v, u = np.mgrid[:height, :width]
    rays = np.stack(((u - setup.cx) / setup.fx, (v - setup.cy) / setup.fy, np.ones(u.shape)), axis=-1) + 1e-9
    frames: list[Frame] = []
    for number in range(2 * GHOST_FRAMES):
        pose = np.eye(4)
        pose[0, 3] = 0.2 * np.sin(number)
        depth = ((ROOM[:, None, None] - pose[:3, 3]) / rays).max(axis=0).min(axis=-1)
        faces = (THING[:, None, None] - pose[:3, 3]) / rays
        enter, leave = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
        if number < GHOST_FRAMES:
            depth = np.where((enter > 0) & (enter < leave), enter, depth)
        rgb = np.full((height, width, 3), 128, np.uint8)
        frames.append(Frame(number * 66_666_667, rgb, depth.astype(np.float32), pose))
    return setup, frames


def ghosts_left(kind: Any, setup: Setup) -> float | None:
    """Surface points of the object when it has been gone for ``GHOST_FRAMES``, as a fraction of those before; None
    where it was never mapped."""
    setup, frames = ghost_frames(setup)
    peer, counts = kind(setup), [0, 0]
    low, high = THING + np.array([[-1], [1]]) * setup.voxel_size_m
    high[1] = THING[1, 1] - 2 * setup.voxel_size_m  # not the floor
    for half in (0, 1):
        for frame in frames[half * GHOST_FRAMES : (half + 1) * GHOST_FRAMES]:
            peer.add(peer.prepare(frame))
        points = np.asarray(peer.points())
        counts[half] = int(((points > low) & (points < high)).all(axis=1).sum())
    return round(counts[1] / counts[0], 4) if counts[0] else None


def peak_mb() -> float:
    """Most memory that this process has held."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def measure(folder: Path, job: dict[str, Any]) -> dict[str, Any]:
    """Run the peer over all frames. Gives milliseconds of each frame and the peaks of memory, or a ``problem``;
    the first repeat also writes ``found.npy``, the surface (N, 3) or poses (N, 4, 4), NaN while lost, and
    counts ghosts."""
    setup = Setup(**job["setup"])
    names = ("stamps", "rgb", "depth", "poses")
    frames = [Frame(*values) for values in zip(*(np.load(folder / f"{name}.npy") for name in names), strict=True)]
    loaded_mb = peak_mb()
    module, _, name = job["peer"].rpartition(":")
    try:
        kind = getattr(import_module(module), name) if module else globals()[name]
        peer = kind(setup)
    except ImportError as error:
        return {"problem": str(error)}
    cpu_ms: list[float] = []
    results: list[Any] = []
    for frame in frames:
        prepared = peer.prepare(frame)
        began = time.process_time()
        results.append(peer.add(prepared))
        cpu_ms.append((time.process_time() - began) * 1e3)
    found = {"cpu_ms": cpu_ms, "loaded_mb": loaded_mb, "peak_mb": peak_mb()}
    if job["scores"] and job["kind"] == "mapper":
        np.save(folder / "found.npy", np.asarray(peer.points(), np.float32))
        found["ghosts"] = ghosts_left(kind, setup)
    elif job["scores"]:
        np.save(folder / "found.npy", np.array([np.full((4, 4), np.nan) if T is None else T for T in results]))
    return found


def main(arguments: Sequence[str]) -> None:
    """Keep to one core, and write ``result.json``."""
    folder, job = Path(arguments[0]), json.loads(arguments[1])
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    (folder / "result.json").write_text(json.dumps(measure(folder, job)), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
