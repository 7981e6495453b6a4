"""Whole films: a rendered walk comes out as it was walked, and what cannot be reconstructed is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from research.experiments.drone_pictures import DIAGONAL_35MM, rows_over, save_picture
from research.experiments.forward_film import compare, pinhole, street_drive, take
from research.experiments.video import write_film
from research.scenes.aerial.views import aerial_camera, cached_town, render_town
from research.scenes.streets.views import cached_street
from semantic_mapper.drivers.calibration import save_calibration
from semantic_mapper.errors import ConfigError, ImportSourceError
from semantic_mapper.evaluation.trajectory import align_similar
from semantic_mapper.geometry import transform
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.film import read_left_out
from semantic_mapper.replay.sfm.reconstruct import FilmOptions, FilmReport, import_film
from semantic_mapper.replay.sfm.scale import Mark, MarkedDistance, ScaleHint
from semantic_mapper.types import Float64
from tests.nodes.support import run

from . import films

COUNT = 44


def quiet(what: str, done: int, total: int) -> None:
    assert what in ("look", "features", "match", "map", "write") and 0 <= done <= total


def path_error_m(log: Path, true: Float64) -> tuple[float, float]:
    """RMS error of the positions after the best similarity, and its scale."""
    with LogReader(log) as reader:
        frames = list(reader)
    found = np.stack([frame.T_world_camera[:3, 3] for frame in frames])
    truth = true[[frame.seq for frame in frames], :3, 3]
    T, scale = align_similar(found, truth)
    return float(np.sqrt((np.linalg.norm(transform(T, scale * found) - truth, axis=1) ** 2).mean())), scale


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Float64]:
    """A film of a walk, and its true poses."""
    poses = films.walk(COUNT)
    return films.write_film(tmp_path_factory.mktemp("film") / "room.mp4", films.take(poses)), poses


@pytest.fixture(scope="module")
def report(walked: tuple[Path, Float64]) -> FilmReport:
    film, _ = walked
    return import_film(film, film.with_suffix(".mcap"), FilmOptions(focal_prior_px=1.1 * films.CAMERA.fx), quiet)


def test_a_film_comes_out_as_it_was_walked(walked: tuple[Path, Float64], report: FilmReport) -> None:
    film, poses = walked
    error, _ = path_error_m(film.with_suffix(".mcap"), poses)
    assert error < 0.03
    assert report.registered >= 0.95 * report.picked and report.frames >= 0.6 * COUNT
    assert report.focal_px == pytest.approx(films.CAMERA.fx, rel=0.1) and report.error_px < 1.5
    assert sum(report.left_out_counts.values()) + report.frames == COUNT == report.looked_at


def test_the_log_says_what_it_is(walked: tuple[Path, Float64], report: FilmReport) -> None:
    with LogReader(walked[0].with_suffix(".mcap")) as log:
        frames, attachments, info = list(log), log.attachments(), log.info
    assert info.source == "film room.mp4" and not info.scale_known and report.scale == ""
    assert read_left_out(attachments) == COUNT - len(frames)
    assert all(f.depth_m is None and f.pose_source == "sfm" and not f.intrinsics.distortion for f in frames)
    assert [f.stamp_ns for f in frames] == [round(f.seq * 1e9 / films.HZ) for f in frames]
    # z is up: the camera is held without roll, looking ahead or a little down.
    assert all(abs(f.T_world_camera[2, 0]) < 0.15 and f.T_world_camera[2, 1] < -0.6 for f in frames)
    assert "the scale is unknown" in " ".join(report.notices)


def test_a_row_over_flat_ground_keeps_the_focal_length_that_its_pictures_tell(tmp_path: Path) -> None:
    camera, folder = aerial_camera(400), tmp_path / "row"
    folder.mkdir()
    told = round(camera.fx * DIAGONAL_35MM / np.hypot(camera.width, camera.height))
    for n, pose in enumerate(rows_over(60.0, 60.0, 1, 9, 65.0)):
        save_picture(folder / f"{n:03d}.jpg", render_town(cached_town(1), camera, pose, n).rgb, pose[:3, 3], told)
    report = import_film(folder, tmp_path / "row.mcap", FilmOptions(), quiet)
    assert report.registered == 9 and report.focal_px == pytest.approx(camera.fx, rel=0.02)  # with a free one: 95 px


def test_films_that_show_nothing_or_stand_still_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    poses = films.walk(2)
    pictures = films.take(poses)
    cases = {
        "are black": [np.zeros_like(pictures[0])] * 20,
        "does not move": [pictures[0]] * 20,
        "too short": pictures,
    }
    for says, frames in cases.items():
        film = films.write_film(tmp_path / "film.mp4", frames)
        with pytest.raises(ImportSourceError, match=says):
            import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_blurred_film_is_refused(tmp_path: Path) -> None:
    import cv2

    pictures = [cv2.GaussianBlur(p, (0, 0), 14) for p in films.take(films.walk(24, step_m=0.12))]
    with pytest.raises(ImportSourceError, match=r"blurred|too short"):
        import_film(films.write_film(tmp_path / "a.mp4", pictures), tmp_path / "a.mcap", FilmOptions(), quiet)


def test_options_that_cannot_be_are_refused_before_anything_is_read(
    tmp_path: Path, walked: tuple[Path, Float64]
) -> None:
    film, _ = walked
    other = dataclasses.replace(films.CAMERA, width=400, height=240)
    save_calibration(tmp_path / "other.toml", other, None, {})
    for options, says in (
        (FilmOptions(calibration=tmp_path / "other.toml"), "another form"),
        (FilmOptions(focal_prior_px=3.0), "no focal length in pixels"),
        (FilmOptions(calibration=tmp_path / "none.toml"), "none.toml"),
    ):
        with pytest.raises(ConfigError, match=says):
            import_film(film, tmp_path / "a.mcap", options, quiet)


@pytest.mark.slow
def test_the_same_film_gives_the_same_poses(tmp_path: Path, walked: tuple[Path, Float64], report: FilmReport) -> None:
    again = import_film(walked[0], tmp_path / "b.mcap", FilmOptions(focal_prior_px=1.1 * films.CAMERA.fx), quiet)
    assert np.array_equal(again.T_world_camera, report.T_world_camera)


@pytest.mark.slow
def test_a_calibrated_film_gets_its_scale_from_two_marked_points_or_a_height(
    tmp_path: Path, walked: tuple[Path, Float64]
) -> None:
    film, poses = walked
    save_calibration(tmp_path / "camera.toml", films.CAMERA, None, {})
    # Two features that the scene has at a known distance: corners of the first picture with their true depth.
    import cv2

    from research.scenes.render import render_view
    from research.scenes.room import make_room

    n = COUNT // 2
    view = render_view(make_room(films.SEED), films.CAMERA, poses[n])
    gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    corners = cv2.goodFeaturesToTrack(gray, 40, 0.05, 20)[:, 0]
    flat = []
    for u, v in corners.tolist():
        z = view.exact_depth_m[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3]
        if z.size == 25 and z.min() > 0 and np.ptp(z) < 0.03 and 40 < u < 280 and 40 < v < 200:
            x = (u - films.CAMERA.cx) / films.CAMERA.fx * z.mean()
            y = (v - films.CAMERA.cy) / films.CAMERA.fy * z.mean()
            flat.append((u, v, np.array((x, y, z.mean()))))
    a, b = max(((p, q) for p in flat for q in flat), key=lambda pair: float(np.linalg.norm(pair[0][2] - pair[1][2])))
    marks = [Mark(n / films.HZ, p[0], p[1]) for p in (a, b)]
    metres = float(np.linalg.norm(a[2] - b[2]))
    hint = ScaleHint(distance=MarkedDistance(*marks, metres))
    found = import_film(film, tmp_path / "a.mcap", FilmOptions(tmp_path / "camera.toml", scale=hint), quiet)
    error, scale = path_error_m(tmp_path / "a.mcap", poses)
    assert found.info.scale_known and error < 0.03 and scale == pytest.approx(1, abs=0.1)
    assert found.focal_px == pytest.approx(films.CAMERA.fx) and not found.notices


@pytest.mark.slow
def test_a_calibration_that_the_pictures_contradict_is_refused(tmp_path: Path, walked: tuple[Path, Float64]) -> None:
    wrong = dataclasses.replace(films.CAMERA, fx=0.475 * films.CAMERA.fx, fy=0.475 * films.CAMERA.fy)
    save_calibration(tmp_path / "wrong.toml", wrong, None, {})
    with pytest.raises(ImportSourceError, match=r"is 129 px of the film, and its pictures fit (1[89]|2\d)\d px"):
        import_film(walked[0], tmp_path / "a.mcap", FilmOptions(tmp_path / "wrong.toml"), quiet)
    assert not list(tmp_path.glob("*.mcap*"))


@pytest.mark.slow
def test_a_hand_held_walk_with_rolling_shutter_is_reconstructed(tmp_path: Path) -> None:
    poses = films.walk(60, seed=100_011)
    film = films.write_film(tmp_path / "a.mp4", films.take(poses, seed=100_011, shutter=0.3))
    found = import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)
    error, _ = path_error_m(tmp_path / "a.mcap", poses)
    assert error < 0.05 and found.registered >= 0.9 * found.picked


@pytest.mark.slow
def test_a_camera_that_turns_on_the_spot_is_refused(tmp_path: Path) -> None:
    from research.scenes.camera import pose_of

    start = films.walk(1)[0][:3, 3]
    poses = np.stack([pose_of(start, yaw, -0.1) for yaw in np.linspace(0.0, 1.6, 40)])
    film = films.write_film(tmp_path / "a.mp4", films.take(poses))
    with pytest.raises(ImportSourceError, match="turns on the spot"):
        import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)


@pytest.mark.slow
def test_a_camera_that_stands_and_looks_around_is_refused(tmp_path: Path) -> None:
    from research.scenes.camera import pose_of

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


@pytest.mark.slow
def test_two_scenes_are_refused_with_their_times(tmp_path: Path) -> None:
    lengths = {films.SEED: 60, 100_011: 40}  # about as many picks of each: of unequal scenes the larger one is mapped
    parts = [films.take(films.walk(count, seed=seed), seed=seed) for seed, count in lengths.items()]
    film = films.write_film(tmp_path / "a.mp4", [*parts[0], *parts[1]])
    with pytest.raises(ImportSourceError, match="cut it"):
        import_film(film, tmp_path / "a.mcap", FilmOptions(), quiet)


@pytest.mark.slow
def test_the_verb_makes_a_map_and_prints_the_report_last(tmp_path: Path, walked: tuple[Path, Float64]) -> None:
    out = tmp_path / "out"
    done = run("replay", walked[0], "--out", out, "--voxel-size", "0.05")
    assert done.returncode == 0, done.stderr
    assert str(out / "report.html") in done.stdout
    summary = json.loads((out / "summary.json").read_text())
    assert summary["weights"]["file"] == "rooms-computed-depth.safetensors"
    assert summary["scale"] == "unknown" and summary["frames"]["left_out"] + summary["frames"]["published"] == COUNT
    assert {"room.mcap", "room.html", "report.html", "map.ply", "map.npz"} <= {file.name for file in out.iterdir()}


def test_what_was_to_tell_the_scale_must_be_in_the_film(tmp_path: Path) -> None:
    with pytest.raises(ImportSourceError, match="no such film"):
        import_film(tmp_path / "none.mp4", tmp_path / "a.mcap", FilmOptions(), quiet)


@pytest.mark.parametrize(
    ("mark", "says"),
    [(Mark(99.0, 5, 5), "last frame is at 2.87 s"), (Mark(1.0, 400, 5), "outside of the film's 320x240")],
)
def test_marks_outside_of_the_film_are_refused(
    tmp_path: Path, walked: tuple[Path, Float64], mark: Mark, says: str
) -> None:
    hint = ScaleHint(distance=MarkedDistance(Mark(1.0, 5, 5), mark, 0.9))
    with pytest.raises(ImportSourceError, match=says):
        import_film(walked[0], tmp_path / "a.mcap", FilmOptions(scale=hint), quiet)
