"""Films of cameras that drive or walk straight ahead, against the truth: placed, error of the path, focal length.

Streets of STREETS are driven along, straight ones and bent ones; rooms of ROOMS are walked through in a straight line.
Errors are those after the best similarity: a film has no scale. A row is one film.

Example: python -m research.experiments.forward_film --streets 200000 200002 --rooms 200003 --out runs/forward
"""

from __future__ import annotations

import argparse
import json
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from research.experiments.video import Walk, write_film
from research.scenes.camera import clearance
from research.scenes.config import NoiseConfig, RoomConfig
from research.scenes.daylight import pose_of
from research.scenes.render import cast_view, light_seen, render_view
from research.scenes.room import make_room
from research.scenes.scene import Scene
from research.scenes.sensor_color import expose
from research.scenes.shots import Shot, sequence_shots
from research.scenes.streets.views import STEP_M, cached_street, exposures, street_pose
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.evaluation.trajectory import align_similar, rotation_angle
from semantic_mapper.geometry import transform
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

STREET_HZ, STREET_STEP_M = 10.0, 0.5  # 18 km/h
ROOM_HZ, ROOM_STEP_M, ROOM_CAMERA_M = 15.0, 0.05, 1.35
HALL = RoomConfig(min_side_m=6.0, max_side_m=9.0)
FOCAL = 0.6  # of the width: 80 degrees wide
GUESS = 1.1  # times the true focal length
_EXPOSURE, _FINER = 1.5, 2
_LINES, _CLEARANCE_M, _STOP_M = 4000, 0.3, 1.2


def pinhole(width: int) -> CameraIntrinsics:
    """The camera of all films: 16:9, without distortion."""
    height = round(width * 9 / 16)
    return CameraIntrinsics(FOCAL * width, FOCAL * width, (width - 1) / 2, (height - 1) / 2, width, height)


def street_drive(seed: int, count: int, width: int) -> Walk:
    """A drive along the street of a seed, ``STREET_STEP_M`` a frame, with the sway of a car and drifting exposure."""
    street, k = cached_street(seed), pinhole(width)
    numbers = np.arange(count) * STREET_STEP_M / STEP_M
    poses = np.stack([street_pose(street, float(number)) for number in numbers])
    light = _EXPOSURE * exposures(seed, count)

    def pictures() -> Iterator[UInt8]:
        for n, pose in enumerate(poses):
            yield take(street.scene, k, pose, float(light[n]), seed + n)

    return Walk(pictures(), poses, STREET_HZ, k.fx, (k.width, k.height))


def take(scene: Scene, k: CameraIntrinsics, pose: Float64, gain: float, seed: int) -> UInt8:
    """A picture (H, W, 3) RGB with noise, of light times ``gain``."""
    n, centre = _FINER, (_FINER - 1) / 2
    finer = CameraIntrinsics(n * k.fx, n * k.fy, n * k.cx + centre, n * k.cy + centre, n * k.width, n * k.height)
    light = light_seen(scene, finer, pose, *cast_view(scene, finer, pose))
    linear = np.asarray(cv2.resize(light, (k.width, k.height), interpolation=cv2.INTER_AREA), np.float32)
    shot = Shot(np.full(3, gain), 1.0, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    still = np.zeros(linear.shape[:2], np.float32)  # no motion blur: no depth is asked for
    return expose(
        linear, still, k, shot, NoiseConfig(depth="none", auto_exposure=0.0), np.random.default_rng((seed, 17))
    )


def room_line(seed: int, width: int) -> Walk:
    """A walk along the longest free straight line in the room of a seed, looking ahead, with the sway of steps."""
    scene, k, rng = make_room(seed, HALL), pinhole(width), np.random.default_rng((seed, 23))
    start, yaw, way = _longest_line(scene, rng)
    s = np.arange(0.0, way, ROOM_STEP_M)
    step = 2 * np.pi * s / 1.3  # two steps
    across, ahead = np.array([-np.sin(yaw), np.cos(yaw), 0.0]), np.array([np.cos(yaw), np.sin(yaw), 0.0])
    shake = np.radians(0.3) * rng.standard_normal((len(s), 2))
    poses = np.stack(
        [
            pose_of(
                start + s[n] * ahead + 0.012 * np.sin(step[n]) * across + np.array([0, 0, 0.01 * np.sin(2 * step[n])]),
                yaw + shake[n, 0],
                -0.05 + shake[n, 1],
            )
            for n in range(len(s))
        ]
    )
    config = NoiseConfig(depth="none")
    shots = sequence_shots(poses, seed, config)

    def pictures() -> Iterator[UInt8]:
        for n, pose in enumerate(poses):
            yield render_view(scene, k, pose, noise=seed + n, noise_config=config, shot=shots[n]).rgb

    return Walk(pictures(), poses, ROOM_HZ, k.fx, (k.width, k.height))


def _longest_line(scene: Scene, rng: np.random.Generator) -> tuple[Float64, float, float]:
    """Start (3,), yaw and length of the longest free line of some drawn ones."""
    w, d, _ = scene.size_m
    best = (np.zeros(3), 0.0, 0.0)
    for _ in range(_LINES):
        ends = rng.uniform((_CLEARANCE_M,) * 2, (w - _CLEARANCE_M, d - _CLEARANCE_M), (2, 2))
        way = float(np.linalg.norm(ends[1] - ends[0]))
        if way <= best[2] + _STOP_M:
            continue
        points = np.column_stack((np.linspace(ends[0], ends[1], 40), np.full(40, ROOM_CAMERA_M)))
        if clearance(scene, points).min() >= _CLEARANCE_M:
            toward = ends[1] - ends[0]
            best = (points[0], float(np.arctan2(toward[1], toward[0])), way - _STOP_M)
    return best


@dataclass(frozen=True, slots=True)
class PathFigures:
    """A reconstruction against the truth, after the best similarity.

    Args:
        way_m: Length of the true path of the frames in the log.
        rmse_m: Of their positions.
        rotation_deg: RMS, after the mean rotation between both has been taken away.
        drift: Scale of the last third of the path over that of the first third.
    """

    way_m: float
    rmse_m: float
    rotation_deg: float
    drift: float


def compare(log: Path, poses: Float64) -> PathFigures:
    """Compare a log with the true poses (N, 4, 4) of all frames of its film."""
    with LogReader(log) as reader:
        frames = list(reader)
    found, true = np.stack([f.T_world_camera for f in frames]), poses[[f.seq for f in frames]]
    T, scale = align_similar(found[:, :3, 3], true[:, :3, 3])
    off = transform(T, scale * found[:, :3, 3]) - true[:, :3, 3]
    # The path of a straight drive does not tell the roll about it: rotations are compared by themselves.
    between = true[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1)
    u, _, vt = np.linalg.svd(between.sum(axis=0))
    mean = u @ np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u @ vt))))) @ vt
    angle = rotation_angle(np.asarray(mean.T @ between, np.float64))
    steps = [np.linalg.norm(np.diff(p[:, :3, 3], axis=0), axis=1) for p in (true, found)]
    third = max(1, len(frames) // 3)
    first, last = (steps[1][part].sum() / steps[0][part].sum() for part in (slice(third), slice(-third, None)))
    return PathFigures(
        float(steps[0].sum()),
        float(np.sqrt((off**2).sum(axis=1).mean())),
        float(np.degrees(np.sqrt((angle**2).mean()))),
        float(last / first),
    )


def run_film(name: str, walk: Walk, lens: str, out: Path) -> dict[str, object]:
    """Write a film, import it, and compare it with the truth: one row of the table."""
    film, log = out / f"{name}.mp4", out / f"{name}-{lens}.mcap"
    if not film.exists():
        write_film(film, walk)
    options = FilmOptions()
    if lens == "guessed":
        options = FilmOptions(focal_prior_px=GUESS * walk.focal_px)
    elif lens == "calibrated":
        save_calibration(out / "camera.toml", pinhole(walk.size[0]), None, {})
        options = FilmOptions(calibration=out / "camera.toml")
    began = _cpu_s()
    row: dict[str, object] = {"film": name, "lens": lens, "frames": len(walk.poses)}
    try:
        report = import_film(film, log, options, lambda *_: None, overwrite=True)
    except ImportSourceError as error:
        return row | {"refused": str(error), "cpu_s": round(_cpu_s() - began, 1)}
    return row | _figures(report, compare(log, walk.poses), walk) | {"cpu_s": round(_cpu_s() - began, 1)}


def _figures(report: FilmReport, path: PathFigures, walk: Walk) -> dict[str, object]:
    return {
        "registered": f"{report.registered}/{report.picked}",
        "in_log": report.frames,
        "way_m": round(path.way_m, 1),
        "ate_percent": round(100 * path.rmse_m / path.way_m, 3),
        "rotation_deg": round(path.rotation_deg, 3),
        "drift_percent": round(100 * (path.drift - 1), 2),
        "focal_percent": round(100 * (report.focal_px / walk.focal_px - 1), 2),
        "notices": list(report.notices),
    }


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def main() -> None:
    """Run the films and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streets", type=int, nargs="*", default=[200_000, 200_001, 200_002, 200_004])
    parser.add_argument("--rooms", type=int, nargs="*", default=[200_003, 200_007, 200_011])
    parser.add_argument("--lens", choices=("unknown", "guessed", "calibrated"), nargs="+", default=["unknown"])
    parser.add_argument("--frames", type=int, default=100, help="of a drive")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    films = [(f"street-{seed}", seed, street_drive) for seed in given.streets]
    for lens in given.lens:
        for name, seed, make in films:
            rows.append(run_film(name, make(seed, given.frames, given.width), lens, given.out))
            print(json.dumps(rows[-1]), flush=True)
        for seed in given.rooms:
            rows.append(run_film(f"room-{seed}", room_line(seed, given.width), lens, given.out))
            print(json.dumps(rows[-1]), flush=True)
    (given.out / "forward.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(table(rows))


COLUMNS = {
    "film": "film",
    "lens": "lens",
    "registered": "placed",
    "in_log": "in the log",
    "way_m": "way, m",
    "ate_percent": "ATE, % of the way",
    "rotation_deg": "rotation, deg",
    "drift_percent": "scale drift, %",
    "focal_percent": "focal length, %",
    "cpu_s": "CPU, s",
}


def table(rows: list[dict[str, object]]) -> str:
    """Rows as Markdown."""
    head = [f"| {' | '.join(COLUMNS.values())} |", f"|{'---|' * len(COLUMNS)}"]
    return "\n".join(head + [f"| {' | '.join(str(row.get(key, '-')) for key in COLUMNS)} |" for row in rows])


if __name__ == "__main__":
    main()
