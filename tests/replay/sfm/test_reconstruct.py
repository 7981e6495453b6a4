"""Whole films: a walk through a drawn room comes out as it was walked, and what cannot be reconstructed is refused."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.errors import ConfigError, ImportSourceError
from semantic_mapper.geometry import align_similar, transform
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.film import read_left_out
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.replay.sfm.scale import ScaleHint
from semantic_mapper.types import PosedFrame
from tests.drawn_room import truth_of
from tests.nodes.support import run

from . import films

Walked = tuple[Path, tuple[PosedFrame, ...]]  # a film, and its true frames
COUNT = 24
GUESS = FilmOptions(focal_prior_px=1.1 * films.CAMERA.fx)


def quiet(what: str, done: int, total: int) -> None:
    assert what in ("reading", "features", "matching", "poses", "writing") and 0 <= done <= total


def path_error_m(log: Path, truth: tuple[PosedFrame, ...]) -> tuple[float, float]:
    """RMS error of the positions after the best similarity, and its scale."""
    with LogReader(log) as reader:
        frames = list(reader)
    found = np.stack([frame.T_world_camera[:3, 3] for frame in frames])
    true = truth_of(truth)[[frame.seq for frame in frames], :3, 3]
    T, scale = align_similar(found, true)
    return float(np.sqrt((np.linalg.norm(transform(T, scale * found) - true, axis=1) ** 2).mean())), scale


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Walked:
    """A film of a walk, and its true frames."""
    frames = films.walk(COUNT, step_m=0.08)
    return films.write_film(tmp_path_factory.mktemp("film") / "room.mp4", films.pictures(frames)), frames


@pytest.fixture(scope="module")
def report(walked: Walked) -> FilmReport:
    return import_film(walked[0], walked[0].with_suffix(".mcap"), GUESS, quiet)


def test_a_film_comes_out_as_it_was_walked(walked: Walked, report: FilmReport) -> None:
    error, _ = path_error_m(walked[0].with_suffix(".mcap"), walked[1])
    assert error < 0.01
    note, count = report.note, len(report.T_world_camera)
    assert note.registered >= 0.95 * note.picked and count >= 0.6 * COUNT
    assert note.focal_px == pytest.approx(films.CAMERA.fx, rel=0.02) and note.error_px < 1.0
    assert sum(note.left_out.values()) + count == COUNT == note.frames
    with LogReader(walked[0].with_suffix(".mcap")) as log:
        frames, attachments, info = list(log), log.attachments(), log.info
    assert info.source == "film room.mp4" and not info.scale_known and report.scale == ""
    assert read_left_out(attachments) == COUNT - len(frames)
    assert all(f.depth_m is None and f.pose_source == "sfm" and not f.intrinsics.distortion for f in frames)
    assert [f.stamp_ns for f in frames] == [round(f.seq * 1e9 / films.HZ) for f in frames]
    # z is up: the camera is held without roll, looking ahead or a little down.
    assert all(abs(f.T_world_camera[2, 0]) < 0.15 and f.T_world_camera[2, 1] < -0.6 for f in frames)
    assert "the scale is unknown" in " ".join(report.notices)


def test_films_that_show_nothing_or_stand_still_are_refused_and_leave_nothing(tmp_path: Path, walked: Walked) -> None:
    first, second = films.pictures(walked[1])[:2]
    blurred = [cv2.GaussianBlur(rgb, (0, 0), 14) for rgb in films.pictures(walked[1])]
    cases = {
        "are black": [np.zeros_like(first)] * 20,
        "does not move": [first] * 20,
        "too short": [first, second],
        "blurred|too short": blurred,
    }
    for says, pictures in cases.items():
        film = films.write_film(tmp_path / "film.mp4", pictures)
        with pytest.raises(ImportSourceError, match=says):
            import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)
    assert not list(tmp_path.glob("*.mcap*"))


def test_options_that_cannot_be_are_refused_before_anything_is_read(tmp_path: Path, walked: Walked) -> None:
    other = dataclasses.replace(films.CAMERA, width=400, height=240)
    save_calibration(tmp_path / "other.toml", other, None, {})
    for options, says in (
        (FilmOptions(calibration=tmp_path / "other.toml"), "another form"),
        (FilmOptions(focal_prior_px=3.0), "no focal length in pixels"),
    ):
        with pytest.raises((ConfigError, ImportSourceError), match=says):
            import_film(walked[0], tmp_path / "a.mcap", options, quiet)


@pytest.mark.slow
def test_a_calibrated_film_keeps_its_lens_and_one_whose_scale_is_not_found_its_poses(
    tmp_path: Path, walked: Walked
) -> None:
    save_calibration(tmp_path / "camera.toml", films.CAMERA, None, {})
    options = FilmOptions(tmp_path / "camera.toml", scale=ScaleHint(board=BoardPoses()))
    found = import_film(walked[0], tmp_path / "a.mcap", options, quiet)
    assert path_error_m(tmp_path / "a.mcap", walked[1])[0] < 0.01
    assert found.note.focal_px == pytest.approx(films.CAMERA.fx)
    assert found.scale == "" and "not metres, since the board tells no scale" in " ".join(found.notices)


@pytest.mark.slow
def test_a_calibration_that_the_pictures_contradict_is_refused(tmp_path: Path, walked: Walked) -> None:
    wrong = dataclasses.replace(films.CAMERA, fx=0.475 * films.CAMERA.fx, fy=0.475 * films.CAMERA.fy)
    save_calibration(tmp_path / "wrong.toml", wrong, None, {})
    with pytest.raises(ImportSourceError, match=r"is 129 px of the film, and its pictures fit \d+ px"):
        import_film(walked[0], tmp_path / "a.mcap", FilmOptions(tmp_path / "wrong.toml"), quiet)
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.slow
def test_the_verb_makes_a_map_and_prints_the_report_last(tmp_path: Path, walked: Walked) -> None:
    out = tmp_path / "out"
    done = run("map", walked[0], "--out", out, "--voxel-size", "0.05")
    assert done.returncode == 0, done.stderr
    assert str(out / "report.html") in done.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert summary["weights"]["file"] == "rooms.safetensors"
    assert summary["scale"] == "unknown" and summary["frames"]["left_out"] + summary["frames"]["published"] == COUNT
    assert {"room.mcap", "report.html", "map.ply", "map.npz"} <= {file.name for file in out.iterdir()}
