"""A peer in a process of its own: ``python worker.py FOLDER JOB``, with the frames in FOLDER and JOB as JSON.

Needs NumPy and the peer alone: VDBFusion has no packages for the Pythons of ours, and runs in an environment of its
own. What ``prepare`` of a peer does, such as points of a depth image, is not timed.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
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
    """What all peers are given: a pinhole camera in pixels, and lengths of the map in metres."""

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


class Peer(NamedTuple):
    """A mapper or an odometry."""

    add: Callable[[Any], Any]  # takes what ``prepare`` gives; of an odometry T_world_camera (4, 4), None while lost
    points: Callable[[], Any] | None = None  # of a mapper: (N, 3) metres on its surface
    prepare: Callable[[Frame], Any] = lambda frame: frame  # is not timed


def opencv(setup: Setup) -> Peer:
    """``cv2.Volume`` of OpenCV 5, HashTSDF; it fuses depth alone."""
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
    volume = cv2.Volume(cv2.VolumeType_HashTSDF, settings)
    return Peer(
        lambda frame: volume.integrate(frame.depth_m, frame.T_world_camera.astype(np.float32)),
        lambda: volume.fetchPointsNormals()[0].reshape(-1, 4)[:, :3],
    )


def vdbfusion(setup: Setup) -> Peer:
    """Without space carving, as in its own examples. Its mesh with holes filled has a second sheet, behind surfaces."""
    make = import_module("vdbfusion").VDBVolume
    if int(np.__version__.split(".")[0]) > 1:
        raise ImportError(f"vdbfusion ends in a segmentation fault with NumPy {np.__version__}; it needs numpy<2")
    volume = make(setup.voxel_size_m, setup.truncation_m, False)
    prepare = partial(_world_points, setup)
    return Peer(lambda given: volume.integrate(*given), lambda: volume.extract_triangle_mesh(False)[0], prepare)


def octomap(setup: Setup) -> Peer:
    """Rays to each voxel with a measurement (``discretize``); its points are centres of occupied voxels."""
    size_m = setup.voxel_size_m
    tree = import_module("pyoctomap").OcTree(size_m)
    options = -1.0, False, True  # no limit of range, inner nodes at once, discretize

    def centres() -> Any:
        # pyoctomap 1.2.2 gives the upper corner of a voxel, and the centre of one within merged leaves.
        return (np.ceil(tree.extractPointCloud()[0] / size_m - 0.25) - 0.5) * size_m

    return Peer(lambda given: tree.insertPointCloud(*given, *options), centres, partial(_world_points, setup))


def small_gicp(setup: Setup) -> Peer:
    """Scans against a model of Gaussian voxels, the last motion continued."""
    gicp = import_module("small_gicp")
    model, poses = gicp.GaussianVoxelMap(0.1), [np.eye(4)]

    def add(points: Any) -> Any:
        scan, _ = gicp.preprocess_points(points, 0.05, num_threads=1)
        if len(poses) > 1:
            guess = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
            result = gicp.align(model, scan, guess, max_correspondence_distance=0.3, num_threads=1)
            if not result.num_inliers:  # `converged` says yes all the same
                return None
            poses.append(result.T_target_source)
        else:
            poses.append(np.eye(4))
        model.insert(scan, poses[-1])
        return poses[-1]

    return Peer(add, prepare=partial(_camera_points, setup))


def kiss_icp(setup: Setup) -> Peer:
    """With its own settings for this range (voxels of 1 % of it), without deskewing, which is for LiDARs."""
    config = import_module("kiss_icp.config").KISSConfig()
    config.data.max_range, config.data.deskew = setup.depth_max_m, False
    config.mapping.voxel_size = setup.depth_max_m / 100
    config.registration.max_num_threads = 1
    odometry = import_module("kiss_icp.kiss_icp").KissICP(config)

    def add(points: Any) -> Any:
        odometry.register_frame(points, np.empty(0))
        return odometry.last_pose

    return Peer(add, prepare=partial(_camera_points, setup))


def _camera_points(setup: Setup, frame: Frame) -> Any:
    v, u = np.nonzero(frame.depth_m)
    z = frame.depth_m[v, u].astype(np.float64)
    return np.stack(((u - setup.cx) / setup.fx * z, (v - setup.cy) / setup.fy * z, z), axis=1)


def _world_points(setup: Setup, frame: Frame) -> tuple[Any, Any]:
    """Points (N, 3) and the camera's place (3,)."""
    R, t = frame.T_world_camera[:3, :3], frame.T_world_camera[:3, 3].copy()
    return _camera_points(setup, frame) @ R.T + t, t


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


def ghosts_left(make: Callable[[Setup], Peer], setup: Setup) -> float | None:
    """Surface points of the object when it has been gone for ``GHOST_FRAMES``, as a fraction of those before; None
    where it was never mapped."""
    setup, frames = ghost_frames(setup)
    peer, counts = make(setup), [0, 0]
    low, high = THING + np.array([[-1], [1]]) * setup.voxel_size_m
    high[1] = THING[1, 1] - 2 * setup.voxel_size_m  # not the floor
    for half in (0, 1):
        for frame in frames[half * GHOST_FRAMES : (half + 1) * GHOST_FRAMES]:
            peer.add(peer.prepare(frame))
        points = np.asarray(peer.points()) if peer.points else np.empty((0, 3))
        counts[half] = int(((points > low) & (points < high)).all(axis=1).sum())
    return round(counts[1] / counts[0], 4) if counts[0] else None


def measure(folder: Path, job: dict[str, Any]) -> dict[str, Any]:
    """Run the peer over all frames. Gives milliseconds of each frame and peaks of memory, or a ``problem``; where
    ``job`` says so it also writes ``found.npy``, the surface (N, 3) or poses (N, 4, 4), NaN while lost, and gives what
    is left of ghosts."""
    setup = Setup(**job["setup"])
    names = ("stamps", "rgb", "depth", "poses")
    frames = [Frame(*values) for values in zip(*(np.load(folder / f"{name}.npy") for name in names), strict=True)]
    loaded_mb = _peak_mb()
    module, _, name = job["peer"].rpartition(":")
    try:
        make = getattr(import_module(module), name) if module else globals()[name]
        peer = make(setup)
    except ImportError as error:
        return {"problem": str(error)}
    cpu_ms: list[float] = []
    results: list[Any] = []
    for frame in frames:
        prepared = peer.prepare(frame)
        began = time.process_time()
        results.append(peer.add(prepared))
        cpu_ms.append((time.process_time() - began) * 1e3)
    found = {"cpu_ms": cpu_ms, "loaded_mb": loaded_mb, "peak_mb": _peak_mb()}
    if job["scores"] and peer.points:
        np.save(folder / "found.npy", np.asarray(peer.points(), np.float32))
        found["ghosts"] = ghosts_left(make, setup)
    elif job["scores"]:
        np.save(folder / "found.npy", np.array([np.full((4, 4), np.nan) if T is None else T for T in results]))
    return found


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


if __name__ == "__main__":
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core: some start threads of their own
    found = measure(Path(sys.argv[1]), json.loads(sys.argv[2]))
    Path(sys.argv[1], "result.json").write_text(json.dumps(found), encoding="utf-8")
