"""Films of towns and streets: what they tell of lens and path, and a camera that only looks around."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from research.experiments.drone_pictures import DIAGONAL_35MM, rows_over, save_picture
from research.experiments.forward_film import compare, pinhole, street_drive, take
from research.experiments.video import write_film
from research.scenes.aerial.views import aerial_camera, cached_town, render_town
from research.scenes.camera import pose_of
from research.scenes.streets.views import cached_street
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, import_film
from tests.replay.sfm import films


def quiet(what: str, done: int, total: int) -> None:
    """No progress."""


def test_a_row_over_flat_ground_keeps_the_focal_length_that_its_pictures_tell(tmp_path: Path) -> None:
    camera, folder = aerial_camera(400), tmp_path / "row"
    folder.mkdir()
    told = round(camera.fx * DIAGONAL_35MM / np.hypot(camera.width, camera.height))
    for n, pose in enumerate(rows_over(60.0, 60.0, 1, 9, 65.0)):
        save_picture(folder / f"{n:03d}.jpg", render_town(cached_town(1), camera, pose, n).rgb, pose[:3, 3], told)
    report = import_film(folder, tmp_path / "row.mcap", FilmOptions(), quiet)
    assert report.registered == 9 and report.focal_px == pytest.approx(camera.fx, rel=0.02)  # with a free one: 95 px


@pytest.mark.slow
def test_a_camera_that_stands_and_looks_around_is_refused(tmp_path: Path) -> None:
    scene = cached_street(200_000).scene
    poses = [pose_of(np.array([10, -1.5, 1.55]), 0.35 * np.sin(n / 6), 0.03 * np.sin(n / 3)) for n in range(70)]
    pictures = [take(scene, pinhole(640), pose, 1.5, n) for n, pose in enumerate(poses)]
    film = films.write_film(tmp_path / "a.mp4", pictures, 10.0)
    with pytest.raises(ImportSourceError, match="turns on the spot"):
        import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)


@pytest.mark.slow
def test_a_drive_straight_ahead_is_reconstructed(tmp_path: Path) -> None:
    drive = street_drive(200_000, 60, 480)
    write_film(tmp_path / "drive.mp4", drive)
    save_calibration(tmp_path / "camera.toml", pinhole(480), None, {})
    log, options = tmp_path / "drive.mcap", FilmOptions(tmp_path / "camera.toml")
    found = import_film(tmp_path / "drive.mp4", log, options, quiet)
    path = compare(log, drive.poses)
    assert found.registered >= 0.95 * found.picked and found.frames >= 30
    assert path.rmse_m < 0.002 * path.way_m and path.rotation_deg < 0.5 and path.drift == pytest.approx(1, abs=0.03)
    assert "straight ahead" in " ".join(found.notices)
