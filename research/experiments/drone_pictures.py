"""Pictures of a drone with GPS in their EXIF data: a rendered town, flown over in rows, imported, against the truth.

Example: python -m research.experiments.drone_pictures --gps-sigma 1.0 --out runs/drone
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from research.scenes.aerial.views import aerial_camera, cached_town, render_town
from research.scenes.daylight import pose_of
from semantic_mapper.evaluation.trajectory import align_similar
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.gps import GpsPosition
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.types import Float64

ORIGIN = GpsPosition(52.52, 13.405, 34.0)
DIAGONAL_35MM = 43.27
DEGREE_M = 111_320.0  # of a sphere: the rows are short


def rows_over(reach_m: float, height_m: float, rows: int, pictures: int, pitch_deg: float) -> Float64:
    """Poses (N, 4, 4) of rows, there and back."""
    poses: list[Float64] = []
    for row, y in enumerate(np.linspace(-0.4, 0.4, rows) * reach_m):
        xs = np.linspace(-0.5, 0.5, pictures) * reach_m
        for x in xs if row % 2 == 0 else xs[::-1]:
            poses.append(
                pose_of(np.array((x, y, height_m + 2 * np.sin(x / 9 + row))), 0.0, -np.radians(pitch_deg), 0.0)
            )
    return np.stack(poses)


def save_picture(file: Path, rgb: np.ndarray, enu: Float64, focal_35mm: int) -> None:
    """A JPEG with its position, and the focal length that a drone's camera writes."""
    east, north, up = enu
    latitude = ORIGIN.latitude + north / DEGREE_M
    longitude = ORIGIN.longitude + east / DEGREE_M / np.cos(np.radians(ORIGIN.latitude))
    image = Image.fromarray(rgb)
    exif = image.getexif()
    angles = {
        at: (IFDRational(int(v)), IFDRational(0), IFDRational(round(v % 1 * 3600 * 1_000_000), 1_000_000))
        for at, v in ((2, latitude), (4, longitude))
    }
    height = IFDRational(round((ORIGIN.altitude_m + up) * 1000), 1000)
    exif.get_ifd(0x8825).update({1: "N", 3: "E", 5: b"\x00", 6: height, **angles})
    exif.get_ifd(0x8769).update({0xA405: focal_35mm})
    image.save(file, exif=exif, quality=92)


def main() -> None:
    """Print what became of the pictures, and how far the poses are from the true ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1, help="of the town")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height-m", type=float, default=60.0)
    parser.add_argument("--rows", type=int, default=3)
    parser.add_argument("--pictures", type=int, default=14, help="a row")
    parser.add_argument("--pitch", type=float, default=65.0, help="degrees below the horizon")
    parser.add_argument("--gps-sigma", type=float, default=1.0, help="error of each position, metres along each axis")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    town, camera = cached_town(given.seed), aerial_camera(given.width)
    poses = rows_over(town.plan.reach_m, given.height_m, given.rows, given.pictures, given.pitch)
    rng, folder = np.random.default_rng(0), given.out / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    for n, pose in enumerate(poses):
        rgb = render_town(town, camera, pose, n).rgb
        position = pose[:3, 3] + rng.normal(0, given.gps_sigma, 3)
        save_picture(
            folder / f"DJI_{n:04d}.JPG",
            rgb,
            position,
            round(camera.fx * DIAGONAL_35MM / np.hypot(camera.width, camera.height)),
        )
    began = time.process_time()
    log = given.out / "flight.mcap"
    report = import_film(folder, log, FilmOptions(), lambda *_: None, overwrite=True)
    print(f"{time.process_time() - began:.0f} CPU s here, without the process of pycolmap")
    show(report, log, poses)


def show(report: FilmReport, log: Path, true: Float64) -> None:
    """Figures."""
    with LogReader(log) as reader:
        frames = list(reader)
    found = np.stack([frame.T_world_camera for frame in frames])
    truth = true[[frame.seq for frame in frames]]
    T, scale = align_similar(found[:, :3, 3], truth[:, :3, 3])
    shape = np.linalg.norm(scale * found[:, :3, 3] @ T[:3, :3].T + T[:3, 3] - truth[:, :3, 3], axis=1)
    off = found[:, :3, 3] - truth[:, :3, 3]
    placed = np.linalg.norm(off - off.mean(axis=0), axis=1)  # the first position's own error moves the whole world
    up = found[:, :3, :3] @ truth[:, :3, :3].transpose(0, 2, 1)
    tilt = np.degrees(np.arccos(np.clip(up[:, 2, 2], -1, 1)))
    print(f"{report.registered} of {len(true)} pictures placed; {len(frames)} in the log; {report.scale}")
    print(
        f"after the best similarity {100 * np.sqrt((shape**2).mean()):.1f} cm rmse; "
        f"scale {100 * (1 / scale - 1):+.2f} %"
    )
    print(
        f"as placed by GPS, but for the origin: {np.sqrt((placed**2).mean()):.2f} m rmse; "
        f"up {np.median(tilt):.2f} degrees off"
    )
    print("\n".join(report.notices))


if __name__ == "__main__":
    main()
