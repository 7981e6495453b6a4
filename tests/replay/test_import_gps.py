"""Pictures that say where they were taken, and OpenSfM's reconstructions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import camera_matrix, invert_pose, look_at
from semantic_mapper.replay.importers import detect_format
from semantic_mapper.replay.sfm.gps import (
    ORIGIN_KEY,
    GpsPosition,
    east_north_up,
    place_by_gps,
    read_position,
)
from semantic_mapper.types import Float64

from .test_import_posed import F, H, W, imported, make_colmap

ORIGIN = GpsPosition(-33.8568, 151.2153, 40.0)  # south and east
METRES_PER_DEGREE = 111_000.0


def flight(count: int = 12) -> Float64:
    """Poses (N, 4, 4) of a circle of 20 m, 30 m above the ground, looking at its middle; x east, y north, z up."""
    angles = np.arange(count) * 2 * np.pi / count
    eyes = np.stack((20 * np.cos(angles), 20 * np.sin(angles), 30 + 2 * np.sin(3 * angles)), axis=1)
    return np.stack([look_at(eye, np.zeros(3), np.eye(3)[2]) for eye in eyes])


def positions_of(enu: Float64) -> list[GpsPosition]:
    """Where places (N, 3) near ``ORIGIN`` are; exact to a millimetre by a few steps of Newton's method."""
    guess = np.zeros_like(enu)
    for _ in range(4):
        found = [
            GpsPosition(
                ORIGIN.latitude + n / METRES_PER_DEGREE, ORIGIN.longitude + e / METRES_PER_DEGREE, ORIGIN.altitude_m + u
            )
            for e, n, u in guess
        ]
        guess += (enu - east_north_up(found, ORIGIN)) * ([1 / np.cos(np.radians(ORIGIN.latitude)), 1, 1])
    return found


def tag(file: Path, position: GpsPosition, **changes: Any) -> None:
    """Write a position into a JPEG's EXIF data, as cameras do."""

    def angle(degrees: float) -> tuple[IFDRational, ...]:
        whole, minutes = int(abs(degrees)), abs(degrees) % 1 * 60
        return (
            IFDRational(whole),
            IFDRational(int(minutes)),
            IFDRational(round(minutes % 1 * 60 * 1_000_000), 1_000_000),
        )

    image = Image.open(file)
    exif = image.getexif()
    exif.get_ifd(0x8825).update(
        {
            1: "N" if position.latitude >= 0 else "S",
            2: angle(position.latitude),
            3: "E" if position.longitude >= 0 else "W",
            4: angle(position.longitude),
            5: b"\x01" if position.altitude_m < 0 else b"\x00",
            6: IFDRational(round(abs(position.altitude_m) * 1000), 1000),
        }
    )
    for key in changes.get("without", ()):
        del exif.get_ifd(0x8825)[key]
    image.save(file, exif=exif, quality=95)


def picture(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((H, W, 3), 90, np.uint8)).save(file)
    return file


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


def test_a_receiver_without_a_fix_and_damaged_files_tell_nothing(tmp_path: Path) -> None:
    tag(picture(tmp_path / "a.jpg"), GpsPosition(0.0, 0.0, 10.0))
    assert read_position(tmp_path / "a.jpg") is None
    (tmp_path / "b.jpg").write_bytes(b"\xff\xd8\xff\xe1\x00\x10Exif\x00\x00MM\x00*")
    assert read_position(tmp_path / "b.jpg") is None


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


@pytest.mark.parametrize(
    ("way", "told", "says"),
    [
        (flight(), [0, 1, 2], "3 of 12 pictures have a GPS position"),
        (
            np.stack([look_at(np.array((n, 0.0, 30.0)), np.array((n, 9.0, 0.0)), np.eye(3)[2]) for n in range(8)]),
            None,
            "line",
        ),
    ],
)
def test_positions_that_do_not_suffice_are_refused(way: Float64, told: list[int] | None, says: str) -> None:
    known = positions_of(way[:, :3, 3])
    chosen = range(len(way)) if told is None else told
    with pytest.raises(ImportSourceError, match=says):
        place_by_gps(in_a_unit_of_its_own(way), [known[n] if n in chosen else None for n in range(len(way))])


def test_positions_that_contradict_the_pictures_are_refused(rng: np.random.Generator) -> None:
    way = flight()
    with pytest.raises(ImportSourceError, match="off"):
        place_by_gps(in_a_unit_of_its_own(way), [*positions_of(rng.normal(0, 20, (len(way), 3)))])
    assert place_by_gps(way, [None] * len(way)) is None


def make_opensfm(folder: Path, poses: Float64, **camera: Any) -> Path:
    """A project with its reconstruction, as OpenSfM writes it."""
    lens = {"projection_type": "perspective", "focal": F / W, "k1": 0.0, "k2": 0.0, "focal_prior": 0.85}
    shots = {}
    for n, T in enumerate(poses):
        name = f"DJI_{n}.JPG"
        picture(folder / "images" / name)
        T_camera_world = invert_pose(T)
        shots[name] = {
            "rotation": cv2.Rodrigues(T_camera_world[:3, :3])[0].ravel().tolist(),
            "translation": T_camera_world[:3, 3].tolist(),
            "camera": "v2 dji",
            "orientation": 1,
            "capture_time": 0.0,
            "gps_dop": 5.0,
        }
    points = {str(n): {"coordinates": [n - 4.0, 0.5 * n, 0.0], "color": [1.0, 2.0, 3.0]} for n in range(9)}
    model = {
        "cameras": {"v2 dji": {"width": W, "height": H, **lens, **camera}},
        "shots": shots,
        "points": points,
        "reference_lla": {"latitude": 52.5, "longitude": 13.4, "altitude": 35.0},
    }
    (folder / "reconstruction.json").write_text(json.dumps([model]))
    return folder


def change(folder: Path, **changes: Any) -> list[dict[str, Any]]:
    models = json.loads((folder / "reconstruction.json").read_text())
    models[0].update(changes)
    (folder / "reconstruction.json").write_text(json.dumps(models))
    return models


def test_a_reconstruction_of_opensfm_is_imported_with_its_metres(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight())
    assert detect_format(folder) == "opensfm"
    report, frames = imported(folder)
    assert report.info.scale_known and report.info.metadata[ORIGIN_KEY].startswith("52.5")
    for frame, T in zip(frames, flight(), strict=True):  # 10 comes behind 9
        assert np.allclose(frame.T_world_camera, T, atol=1e-9)
    k = frames[0].intrinsics
    assert (k.fx, k.cx, k.cy) == (pytest.approx(F), (W - 1) / 2, (H - 1) / 2)
    with pytest.raises(ImportSourceError, match="in metres already"):
        imported(folder, scale=2.0)


def test_a_project_of_opendronemap_is_imported(tmp_path: Path) -> None:
    made = make_opensfm(tmp_path / "project", flight(4))
    (made / "opensfm").mkdir()
    (made / "reconstruction.json").rename(made / "opensfm" / "reconstruction.json")
    assert imported(made)[0].frames == 4


def test_a_reconstruction_without_gps_is_made_of_room_size(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight())
    for reference in (None, {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}):
        change(folder, reference_lla=reference)
        report, frames = imported(folder)
        assert not report.info.scale_known
        ratio = np.linalg.norm(frames[6].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3]) / 40
        assert ratio == pytest.approx(2 / 36, rel=0.1)  # cameras are 36 m from the points
    assert imported(folder, scale=3.0)[0].info.scale_known
    (folder / "reference_lla.json").write_text('{"latitude": 1.0, "longitude": 2.0, "altitude": 3.0}')
    change(folder, reference_lla=None)
    assert imported(folder)[0].info.scale_known
    change(folder, reference_lla={"latitude": 200.0, "longitude": 0.0, "altitude": 0.0})
    with pytest.raises(ImportSourceError, match=r"reference_lla\.latitude|<= 90"):
        imported(folder)


def test_a_lens_of_browns_model_is_undone(tmp_path: Path) -> None:
    """Where OpenSfM projects a point in the picture with distortion, a white dot is where the log's camera has it."""
    lens = {"k1": -0.2, "k2": 0.05, "p1": 0.004, "p2": -0.003, "k3": 0.01}
    brown = {"projection_type": "brown", "focal_x": 0.7, "focal_y": 0.72, "c_x": 0.02, "c_y": -0.03}
    folder = make_opensfm(tmp_path / "flight", flight(4), **brown, **lens)
    x, y = -0.3, 0.25  # on the plane at depth 1
    r2 = x * x + y * y
    radial = 1 + r2 * (lens["k1"] + r2 * (lens["k2"] + r2 * lens["k3"]))
    u = 0.7 * (x * radial + 2 * lens["p1"] * x * y + lens["p2"] * (r2 + 2 * x * x)) + 0.02
    v = 0.72 * (y * radial + 2 * lens["p2"] * x * y + lens["p1"] * (r2 + 2 * y * y)) - 0.03
    pixel = np.array((u * W + W / 2 - 0.5, v * W + H / 2 - 0.5))
    rows, columns = np.mgrid[:H, :W]
    dot = 255 * np.exp(-((columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2) / 4)
    Image.fromarray(np.repeat(dot[..., None], 3, 2).astype(np.uint8)).save(folder / "images" / "DJI_0.JPG", quality=98)
    frame = imported(folder)[1][0]
    light = np.where(frame.rgb[..., 0] > 60, frame.rgb[..., 0], 0).astype(float)
    found = np.array(((light * columns).sum(), (light * rows).sum())) / light.sum()
    expected = (camera_matrix(frame.intrinsics) @ (x, y, 1))[:2]
    assert np.abs(found - expected).max() < 0.3 < np.abs(pixel - expected).max()


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ({"projection_type": "spherical"}, "'spherical' is not read"),
        ({"projection_type": "brown", "focal": 0.8, "k4": 0.1}, "with k4 is not read"),
        ({"projection_type": "brown", "focal": None}, "no focal length"),
    ],
)
def test_lenses_that_are_not_read_are_told(tmp_path: Path, camera: dict[str, Any], says: str) -> None:
    with pytest.raises(ImportSourceError, match=says):
        imported(make_opensfm(tmp_path / "flight", flight(4), **camera))


def test_a_camera_that_no_picture_uses_may_have_any_lens(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight(4))
    cameras = json.loads((folder / "reconstruction.json").read_text())[0]["cameras"]
    round_ones = {"width": 64, "height": 48, "projection_type": "fisheye", "focal": 0.5}
    change(folder, cameras=cameras | {"other": round_ones})
    assert len(imported(folder)[1]) == 4


def test_what_is_wrong_with_a_reconstruction_is_told(tmp_path: Path) -> None:
    folder = make_opensfm(tmp_path / "flight", flight(4))
    whole = (folder / "reconstruction.json").read_text()
    small = json.loads(whole)[0] | {"shots": dict(list(json.loads(whole)[0]["shots"].items())[:2])}
    (folder / "reconstruction.json").write_text(json.dumps([small, *json.loads(whole)]))
    report, frames = imported(folder)
    assert len(frames) == 4 and "2 parts" in " ".join(report.notices)
    for changes, says in (
        ({"cameras": {}}, "camera 'v2 dji' is missing"),
        ({"shots": {}}, "no posed picture"),
        ({"shots": {"../a.jpg": {"rotation": [0, 0, 0], "translation": [0, 0, 0], "camera": "v2 dji"}}}, "outside"),
        ({"shots": {"DJI_0.JPG": {"rotation": [0, 0], "translation": [0, 0, 0], "camera": "v2 dji"}}}, "rotation"),
    ):
        (folder / "reconstruction.json").write_text(whole)
        change(folder, **changes)
        with pytest.raises(ImportSourceError, match=says):
            imported(folder)
    (folder / "reconstruction.json").write_text(whole[:100])
    with pytest.raises(ImportSourceError, match="not valid JSON"):
        imported(folder)
    (folder / "reconstruction.json").write_text(whole)
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(ImportSourceError, match="pictures are missing"):
        imported(folder)


def test_a_colmap_model_of_pictures_with_gps_comes_in_metres(tmp_path: Path) -> None:
    """Beside a square of cameras whose positions are five times as far apart as the model has them."""
    folder = make_colmap(tmp_path / "scan", "txt")
    lines, model = [], flight(4)
    for n, T in enumerate(model):
        inverse = invert_pose(T)
        angle_axis = cv2.Rodrigues(inverse[:3, :3])[0].ravel()
        half = np.linalg.norm(angle_axis) / 2
        q = (np.cos(half), *(np.sin(half) * angle_axis / (2 * half)))
        lines += [f"{n} {' '.join(map(repr, map(float, (*q, *inverse[:3, 3]))))} 1 {n}.jpg", ""]
        tag(picture(folder / "images" / f"{n}.jpg"), positions_of(5 * model[:, :3, 3])[n])
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    report, frames = imported(folder)
    assert report.info.scale_known and "GPS of 4 pictures" in " ".join(report.notices)
    steps = np.stack([f.T_world_camera[:3, 3] for f in frames]) - frames[0].T_world_camera[:3, 3]
    assert np.allclose(steps, 5 * (model[:, :3, 3] - model[0, :3, 3]), atol=0.02)
    assert not imported(folder, scale=1.0)[0].info.metadata.get(ORIGIN_KEY)  # who gives a scale has it
