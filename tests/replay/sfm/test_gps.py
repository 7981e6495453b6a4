"""Pictures that say where they were taken, and models that are placed by that."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, look_at
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, GpsPosition, east_north_up, place_by_gps, read_position
from semantic_mapper.types import Float64
from tests.replay.recordings import ORIGIN, flight, imported, make_colmap, picture, positions_of, tag


@pytest.mark.parametrize("position", [ORIGIN, GpsPosition(52.5, -0.1, -3.25)])
def test_positions_are_read_from_exif_data(tmp_path: Path, position: GpsPosition) -> None:
    tag(picture(tmp_path / "a.jpg"), position)
    found = read_position(tmp_path / "a.jpg")
    assert found is not None
    assert np.allclose(east_north_up([found], position), 0, atol=2e-3)


@pytest.mark.parametrize("without", [(2,), (4,), (6,)])
def test_a_picture_without_all_of_a_position_has_none(tmp_path: Path, without: tuple[int, ...]) -> None:
    assert read_position(picture(tmp_path / "a.jpg")) is None
    tag(tmp_path / "a.jpg", ORIGIN, without=without)
    assert read_position(tmp_path / "a.jpg") is None
    assert read_position(tmp_path / "missing.jpg") is None


def test_metres_follow_the_ellipsoid() -> None:
    """A degree of latitude at the equator is 110.574 km, of longitude 111.320 km (WGS 84)."""
    zero = GpsPosition(0.0, 0.0, 0.0)
    north, east, up = east_north_up(
        [GpsPosition(0.5, 0.0, 0.0), GpsPosition(0.0, 0.5, 0.0), GpsPosition(0.0, 0.0, 7.0)], zero
    )
    assert north[1] == pytest.approx(110_574 / 2, rel=1e-4) and abs(north[0]) < 1e-6
    assert east[0] == pytest.approx(111_320 / 2, rel=1e-4)
    assert np.allclose(up, (0, 0, 7))


def in_a_unit_of_its_own(poses: Float64) -> Float64:
    """The poses as structure from motion would give them: turned, moved, a seventh as large."""
    T = look_at(np.array((3.0, 1.0, 2.0)), np.array((0.0, 0.5, 1.0)), np.eye(3)[2])
    moved = T @ poses
    moved[:, :3, 3] /= 7
    return moved


def test_a_model_is_placed_where_its_pictures_were_taken_despite_a_wrong_one(rng: np.random.Generator) -> None:
    true = flight()
    enu = true[:, :3, 3] + rng.normal(0, 0.3, (len(true), 3))
    enu[5] += (0, 400, 0)
    told: list[GpsPosition | None] = [*positions_of(enu)]
    told[3] = None
    fit = place_by_gps(in_a_unit_of_its_own(true), told)
    assert fit is not None and fit.scale == pytest.approx(7, rel=0.03) and fit.pictures < 11 and fit.error_m < 1
    placed = np.stack([fit.moved(pose) for pose in in_a_unit_of_its_own(true)])
    moved = placed[:, :3, 3] - (true[:, :3, 3] - enu[0])  # the origin is the first picture's position
    assert np.abs(moved).max() < 1.0
    turned = placed[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1)
    assert np.degrees(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)).max() < 3


def test_positions_that_are_few_on_a_line_or_contradict_the_pictures_are_refused(rng: np.random.Generator) -> None:
    way, up = flight(), np.eye(3)[2]
    line = np.stack([look_at(np.array((n, 0.0, 30.0)), np.array((n, 9.0, 0.0)), up) for n in range(8)])
    few = [*positions_of(way[:3, :3, 3]), *[None] * (len(way) - 3)]
    beside, wrong = np.tile(line, (2, 1, 1)), rng.normal(0, 0.02, (16, 3))  # pictures beside a line, wrong GPS of these
    beside[8:, 0, 3] += 8.0
    beside[[3, 9], 1, 3], wrong[[3, 9]] = (6.0, -6.0), ((40.0, 25.0, 30.0), (-35.0, 30.0, -20.0))
    for poses, known, says in (
        (beside, positions_of(beside[:, :3, 3] + wrong), "line"),
        (way, few, "3 of 12 pictures have a GPS position"),
        (line, positions_of(line[:, :3, 3]), "line"),
        (way, positions_of(rng.normal(0, 20, (len(way), 3))), "off"),
    ):
        with pytest.raises(ImportSourceError, match=says):
            place_by_gps(in_a_unit_of_its_own(poses), [*known])
    assert place_by_gps(way, [None] * len(way)) is None


def test_a_colmap_model_of_pictures_with_gps_comes_in_metres(tmp_path: Path) -> None:
    """Beside a square of cameras whose positions are five times as far apart as the model has them."""
    folder = make_colmap(tmp_path / "scan", "txt")
    lines, model = [], flight(4)
    for n, T in enumerate(model):
        inverse = invert_pose(T)
        angle_axis = cv2.Rodrigues(inverse[:3, :3])[0].ravel()
        half = np.linalg.norm(angle_axis) / 2
        q = (np.cos(half), *(np.sin(half) * angle_axis / (2 * half)))
        lines += [f"{n + 1} {' '.join(map(repr, map(float, (*q, *inverse[:3, 3]))))} 1 {n}.jpg", ""]
        tag(picture(folder / "images" / f"{n}.jpg"), positions_of(5 * model[:, :3, 3])[n])
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "sparse" / "0" / "points3D.txt").write_text("")
    report, frames = imported(folder)
    assert report.info.scale_known and "GPS of 4 pictures" in " ".join(report.notices)
    steps = np.stack([f.T_world_camera[:3, 3] for f in frames]) - frames[0].T_world_camera[:3, 3]
    assert np.allclose(steps, 5 * (model[:, :3, 3] - model[0, :3, 3]), atol=0.02)
    assert not imported(folder, scale=1.0)[0].info.metadata.get(ORIGIN_KEY)  # who gives a scale has it
