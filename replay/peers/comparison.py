"""Run mappers and odometries on one log, each run in a process of its own, and say what each costs and is worth."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from semantic_mapper import plots
from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import LogError
from semantic_mapper.files import write_json
from semantic_mapper.geometry import align_similar, invert_pose, pose_distance
from semantic_mapper.labels import LabelSet
from semantic_mapper.replay.evaluate.mesh_surface import read_mesh, surface_figures
from semantic_mapper.replay.job_monitor import JobMonitor
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.replay.peers.fusion import make_setup
from semantic_mapper.types import Float64, PosedFrame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WARM_UP = 3  # frames that do not count: first growth of buffers
_HERE = "semantic_mapper.replay.peers"
_EXTRA = "pip install 'semantic-mapper[peers]'"
_OWN = "uv venv -p 3.10 vdb && uv pip install -p vdb vdbfusion 'numpy<2', then --python vdbfusion=vdb/bin/python"


class PeerKind(NamedTuple):
    """One that can be measured."""

    kind: str  # mapper or odometry
    title: str
    runs: str  # MODULE:FUNCTION; without a module, of the worker
    install: str = _EXTRA  # what brings it


PEERS = {
    "ours": PeerKind("mapper", "ours, 20 classes", f"{_HERE}.fusion:ours_with_classes"),
    "ours-no-classes": PeerKind("mapper", "ours, no classes", f"{_HERE}.fusion:ours"),
    "open3d": PeerKind("mapper", "Open3D grid", f"{_HERE}.fusion:open3d"),
    "opencv": PeerKind("mapper", "OpenCV HashTSDF", "opencv", "pip install 'opencv-contrib-python-headless>=5'"),
    "vdbfusion": PeerKind("mapper", "VDBFusion", "vdbfusion", _OWN),
    "octomap": PeerKind("mapper", "OctoMap", "octomap"),
    "ours-odometry": PeerKind("odometry", "ours", f"{_HERE}.odometry:ours"),
    "small-gicp": PeerKind("odometry", "small_gicp", "small_gicp"),
    "kiss-icp": PeerKind("odometry", "KISS-ICP", "kiss_icp", f"{_EXTRA}, with Python below 3.14"),
    "open3d-odometry": PeerKind("odometry", "Open3D RGB-D", f"{_HERE}.odometry:open3d"),
}


def read_frames(log: Path, count: int) -> tuple[list[PosedFrame], LabelSet | None]:
    """The first frames with depth of the first camera of a log, and their label set. Raises LogError: too few."""
    with LogReader(log) as reader:
        with_depth = (frame for frame in reader if frame.depth_m is not None)
        first = next(with_depth, None)
        same = (f for f in with_depth if first and (f.camera_id, f.intrinsics) == (first.camera_id, first.intrinsics))
        frames = [first, *itertools.islice(same, count - 1)] if first else []
        label_set = reader.info.label_set
    if len(frames) <= WARM_UP or frames[0].intrinsics.distorted:
        raise LogError(
            f"{log}: {len(frames)} rectified frames with depth of one camera; this needs more than {WARM_UP}"
        )
    return frames, label_set


def compare_peers(
    frames: Sequence[PosedFrame],
    config: VoxelMapConfig,
    *,
    truth: Path | None = None,
    pythons: Mapping[str, str] = {},
    names: Sequence[str] = tuple(PEERS),
    repeats: int = 3,
    seed: int = 0,
    monitor: JobMonitor | None = None,
) -> dict[str, Any]:
    """Run each peer ``repeats`` times over frames of one camera, in an order that ``seed`` shuffles, on one core.

    ``truth`` is a mesh (``read_mesh``) for the surfaces; ``pythons`` are interpreters of peers that have an
    environment of their own. Raises MapError: the mesh cannot be read. LogError: no room for the frames.

    Gives plain data, in ``peers`` a row for each: ``cpu_ms`` of the process a frame (the mean over frames; median,
    least and largest of the repeats), ``loaded_mb`` with the frames and ``peak_mb`` at the end, and of mappers
    ``surface_figures`` and ``ghosts`` (``worker.ghosts_left``), of odometries those of ``drift``. One that does not
    run has its ``problem`` and the command that brings it.
    """
    mesh = None if truth is None else read_mesh(truth)[:2]
    setup = make_setup(frames[0].intrinsics, config)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    scores: dict[str, dict[str, Any]] = {}
    jobs = [(name, repeat) for repeat in range(repeats) for name in names]
    random.Random(seed).shuffle(jobs)
    monitor = monitor or JobMonitor()
    monitor.start(len(jobs))
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-peers-") as folder:
        _write(Path(folder), frames, config.depth_max_m)
        poses = np.stack([frame.T_world_camera for frame in frames])
        for done, (name, repeat) in enumerate(jobs):
            monitor.set(done, PEERS[name].title)
            if any("problem" in run for run in found[name]):
                continue
            kind = PEERS[name].kind
            job = {"peer": PEERS[name].runs, "scores": repeat == 0, "setup": dataclasses.asdict(setup)}
            run = _run(Path(folder), job, pythons.get(name, sys.executable))
            found[name].append(run)
            if repeat or "problem" in run:
                continue
            scores[name] = {"ghosts": run["ghosts"]} if kind == "mapper" else {}
            if kind == "odometry":
                scores[name] = drift(poses, np.load(Path(folder) / "found.npy"))
            elif mesh is not None and len(xyz := np.load(Path(folder) / "found.npy")):
                scores[name] |= surface_figures(xyz, *mesh)
    rows = [_row(name, runs, scores.get(name, {})) for name, runs in found.items()]
    return {"frames": len(frames), "repeats": repeats, "threads": 1, "voxel_size_m": config.voxel_size_m, "peers": rows}


def drift(poses: Float64, found: Float64) -> dict[str, Any]:
    """How far an odometry is from poses (N, 4, 4); its own are NaN while it is ``lost``.

    ``rpe_m``, ``rpe_deg``: RMS error of the motion from one frame to the next; ``ate_m``: RMS distance of positions
    after a rigid alignment (Sturm et al., 2012); null where fewer than 3 frames have a pose."""
    tracked = np.isfinite(found[:, 0, 0])
    figures: dict[str, Any] = {"lost": int((~tracked).sum()), "rpe_m": None, "rpe_deg": None, "ate_m": None}
    both = np.flatnonzero(tracked[:-1] & tracked[1:])
    if tracked.sum() < 3 or not len(both):
        return figures
    motions = [[invert_pose(T[i]) @ T[i + 1] for T in (poses, found)] for i in both]
    figures["rpe_m"], turn = np.sqrt(np.mean([np.square(pose_distance(*pair)) for pair in motions], axis=0))
    figures["rpe_deg"] = np.degrees(turn)
    a, b = found[tracked, :3, 3], poses[tracked, :3, 3]
    if np.ptp(a, axis=0).any():
        R = align_similar(a, b)[0][:3, :3]
        off = (a - a.mean(axis=0)) @ R.T - (b - b.mean(axis=0))
        figures["ate_m"] = np.sqrt((off**2).sum(axis=1).mean())
    return {name: round(float(x), 5) if isinstance(x, float) else x for name, x in figures.items()}


def write_peers(folder: Path, found: Mapping[str, Any]) -> None:
    """Write ``results.json`` and ``peers.png``. Raises SemanticMapperError: they cannot be written."""
    write_json(folder / "results.json", found)
    plots.write_picture(folder / "peers.png", draw_peers(found))


@plots.rendered
def draw_peers(found: Mapping[str, Any]) -> Figure:
    """CPU time and memory of those that ran, 1200 pixels wide."""
    figure = plots.new_figure(1200, 640, layout="constrained")
    axes = figure.subplots(2, 2, height_ratios=(6, 4))
    for line, kind in zip(axes, ("mapper", "odometry"), strict=True):
        rows = [row for row in reversed(found["peers"]) if row["kind"] == kind and row["cpu_ms"]]
        names = [row["title"] for row in rows]
        middle, low, high = np.array([row["cpu_ms"] for row in rows]).reshape(-1, 3).T
        line[0].barh(names, middle, xerr=(middle - low, high - middle), ecolor=plots.hex_color(plots.TEXT))
        title = f"{kind}: CPU ms a frame, one thread; least to largest of {found['repeats']}"
        line[0].set(title=title, xscale="log", xlim=(1, None))
        line[0].xaxis.set_major_formatter("{x:g}")
        line[1].barh(names, [row["peak_mb"] - row["loaded_mb"] for row in rows], color=plots.CYCLE[1])
        line[1].set(title="peak memory without the frames, MB", yticklabels=[])
    return figure


def _write(folder: Path, frames: Sequence[PosedFrame], depth_max_m: float) -> None:
    depth = np.stack([np.asarray(frame.depth_m, np.float32) for frame in frames])
    depth[~((depth > 0) & (depth <= depth_max_m))] = 0  # NaN, too
    try:
        np.save(folder / "depth.npy", depth)
        np.save(folder / "rgb.npy", np.stack([frame.rgb for frame in frames]))
        np.save(folder / "poses.npy", np.stack([frame.T_world_camera for frame in frames]))
        np.save(folder / "stamps.npy", [frame.stamp_ns for frame in frames])
    except OSError as error:
        raise LogError(
            f"{folder}: the frames cannot be written: {error}; free some space, or name another folder (TMPDIR)"
        ) from error


def _run(folder: Path, job: Mapping[str, Any], python: str) -> dict[str, Any]:
    """What the worker found, or a ``problem``."""
    (result := folder / "result.json").unlink(missing_ok=True)
    command = [python, str(Path(__file__).with_name("worker.py")), str(folder), json.dumps(job)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    except OSError as error:
        return {"problem": f"{python}: {error.strerror}"}
    if done.returncode or not result.exists():
        said = done.stderr.strip().splitlines() or ["no message"]
        return {"problem": f"ended with code {done.returncode}: {said[-1]}"}
    return json.loads(result.read_text(encoding="utf-8"))


def _row(name: str, runs: Sequence[Mapping[str, Any]], scores: Mapping[str, Any]) -> dict[str, Any]:
    kind, title, _, install = PEERS[name]
    row: dict[str, Any] = {"name": name, "kind": kind, "title": title, "cpu_ms": []}
    problems = [run["problem"] for run in runs if "problem" in run]
    if problems:
        return {**row, "problem": problems[0], "install": install}
    means = [float(np.mean(run["cpu_ms"][WARM_UP:])) for run in runs]
    row["cpu_ms"] = [round(float(value), 2) for value in (np.median(means), min(means), max(means))]
    for key in ("loaded_mb", "peak_mb"):
        row[key] = round(float(np.median([run[key] for run in runs])), 1)
    return {**row, **scores}
