"""One bad value costs what it is of, and is named; what concerns all frames stops the import with what to do."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers.tables import seconds_to_ns, unknown_notice
from tests.replay import recordings as rec
from tests.replay.recordings import DRIVE, H, W, imported

Edit = Callable[[Path], Any]
MAKERS: dict[str, Callable[[Path], Path]] = {
    "folder": rec.make_folder,
    "tum": rec.make_tum,
    "scannet": rec.make_scannet,
    "replica": lambda folder: rec.make_replica(folder, 3, 64, 48),
    "kitti360": rec.make_kitti360,
    "transforms": rec.make_transforms,
    "depth": lambda folder: rec.add_depth(rec.make_transforms(folder)),
    "colmap": lambda folder: rec.make_colmap(folder, "txt"),
    "colmap.bin": lambda folder: rec.make_colmap(folder, "bin"),
    "polycam": rec.make_polycam,
    "record3d": rec.make_record3d,
    "opensfm": lambda folder: rec.make_opensfm(folder, rec.flight(4)),
}
SPARSE = "sparse/0/"
EYE = np.eye(4).tolist()
POSES = f"data_poses/{DRIVE}/cam0_to_world.txt"


def write(name: str, content: str | bytes) -> Edit:
    return lambda folder: (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def text(name: str, old: str, new: str, count: int = -1) -> Edit:
    def edit(folder: Path) -> None:
        found = (folder / name).read_text()
        assert old in found, (old, found)
        (folder / name).write_text(found.replace(old, new, count))

    return edit


def row(name: str, number: int, new: str) -> Edit:
    def edit(folder: Path) -> None:
        rows = (folder / name).read_text().splitlines()
        rows[number] = new
        (folder / name).write_text("\n".join(rows) + "\n")

    return edit


def remove(*names: str) -> Edit:
    def edit(folder: Path) -> None:
        for name in names:
            for file in [folder / name] if (folder / name).is_file() else list((folder / name).iterdir()):
                file.unlink()

    return edit


def keys(name: str, **more: Any) -> Edit:
    return lambda folder: rec.change_json(folder / name, **more)


def frame(**more: Any) -> Edit:
    """Of the second frame of transforms.json; None = without."""

    def edit(folder: Path) -> None:
        found = json.loads((folder / "transforms.json").read_text())
        found["frames"][1] = {key: value for key, value in (found["frames"][1] | more).items() if value is not None}
        (folder / "transforms.json").write_text(json.dumps(found))

    return edit


def model(change: Callable[[dict[str, Any]], Any]) -> Edit:
    """Of OpenSfM; what ``change`` returns is another model."""

    def edit(folder: Path) -> None:
        (found,) = json.loads((folder / "reconstruction.json").read_text())
        more = change(found)
        (folder / "reconstruction.json").write_text(json.dumps([found, *([more] if isinstance(more, dict) else [])]))

    return edit


def shot(name: str = "DJI_0.JPG", **more: Any) -> Edit:
    def change(found: dict[str, Any]) -> None:
        found["shots"][name] = found["shots"].pop("DJI_0.JPG") | more

    return model(change)


def images(name: str, image: np.ndarray) -> Edit:
    return lambda folder: [cv2.imwrite(str(file), image) for file in (folder / name).iterdir()]


WIDE = np.full((H, W // 2), 1500, np.uint16)
K = '{{"width": 32, "height": 24, "fx": {}, "fy": {}, "cx": {}, "cy": 12}}'
STOPS: list[tuple[str, Edit, str]] = [
    ("folder", write("intrinsics.json", "{"), "intrinsics.json"),
    ("folder", write("intrinsics.json", '{"width": ' + "[" * 100_000), "intrinsics.json: "),
    ("folder", write("intrinsics.json", K.format('"f"', 1, 1)), "intrinsics.json.*fx"),
    ("folder", write("intrinsics.json", K.format(31, 31, 1e19)), "intrinsics.json"),
    ("folder", keys("intrinsics.json", fx=0.8, fy=1.1, cx=0.5, cy=0.5), "intrinsics.json.*normalised"),
    ("folder", keys("intrinsics.json", depth_scale=0.001), "where it is metres per unit, write 1000"),
    ("folder", keys("intrinsics.json", distortion=[0.1], camera_model="omni"), "'omni' is not undone"),
    ("folder", keys("intrinsics.json", dist_coeffs=[0.1]), "'dist_coeffs' is not read"),
    ("folder", write("labels.json", '{"classes": {"one": "wall"}}'), "labels.json"),
    ("folder", write("labels.json", '{"classes": {"1": "wall", "2": "wall"}}'), "twice"),
    ("folder", write("poses.txt", ""), "holds no pose"),
    ("folder", write("timestamps.txt", "1\n2"), "a stamp for each of 6 frames"),
    ("folder", write("timestamps.txt", "1\n2\n3\n4\n5\n6"), "1 ns apart; whole numbers are nanoseconds"),
    ("folder", lambda f: (f / "poses.txt").unlink() or os.mkfifo(f / "poses.txt"), "poses.txt: is no regular file"),
    ("tum", write("groundtruth.txt", "1305031102175304000 0 0 0 0 0 0 1\n"), "line 1: .*divide nanoseconds by 1e9"),
    ("tum", write("groundtruth.txt", "1305031102.1 0 0 0 0 0 0 2\n"), "its quaternion has length 2, not 1"),
    ("scannet", remove("intrinsic/intrinsic_depth.txt"), "intrinsic_depth.txt"),
    ("scannet", write("intrinsic/intrinsic_color.txt", "0.8 0 0.5 0 0 1.1 0.5 0 0 0 1 0 0 0 0 1"), "color.*normalised"),
    ("replica", write("../habitat/info_semantic.json", '{"classes": [{"id": "three"}]}'), r"info_semantic\.json.*int"),
    ("kitti360", write(POSES, "250 1 0 0 0 0 1 0 0 0 0 1 0\n"), "poses.txt, with 12, is another file"),
    ("kitti360", text("calibration/perspective.txt", "S_rect_00: 64", "S_rect_00: nan"), "perspective.txt"),
    ("kitti360", lambda f: (f / "data_2d_raw/2013_05_28_drive_0002_sync").mkdir(), "holds 2 drives .*name the folder"),
    ("transforms", keys("transforms.json", camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' is not undone"),
    ("transforms", keys("transforms.json", is_fisheye=True, p1=0.01), "no p1 that programs agree on"),
    ("transforms", keys("transforms.json", from_mitsuba=True), "'from_mitsuba' is not read"),
    ("transforms", keys("transforms.json", coordinate_system="unity"), "'coordinate_system' is not read"),
    ("transforms", keys("transforms.json", fl_x=None, fl_y=None), "no focal length"),
    ("transforms", keys("transforms.json", units="furlong"), "'units' is not read"),
    ("transforms", keys("transforms.json", frames=3), "frames"),
    ("transforms", keys("transforms.json", frames=[{"file_path": "../a.png", "transform_matrix": EYE}]), "outside"),
    ("depth", images("depths", WIDE), "another form.*--topic depth=none"),
    ("colmap", write(SPARSE + "cameras.txt", "1 FOV 64 48 50 50 32 24 0.9\n"), "lens model 'FOV' is not read"),
    ("colmap", text(SPARSE + "cameras.txt", "\n1 ", "\n2 "), "pycolmap ended"),
    ("colmap", row(SPARSE + "images.txt", 1, "1 x 0 0 0 0 0 0 1 0.png"), "pycolmap ended"),
    ("colmap", remove("images"), "pictures are missing"),
    ("colmap.bin", lambda f: os.truncate(f / SPARSE / "images.bin", 200), "pycolmap ended"),
    ("record3d", keys("metadata.json", poses=[]), "holds no posed picture.*its pose is missing"),
    ("opensfm", model(lambda m: m.update(cameras={})), "camera 'v2 dji' is missing"),
    ("opensfm", model(lambda m: m["cameras"]["v2 dji"].update(projection_type="spherical")), "'spherical' is not read"),
    ("opensfm", model(lambda m: m["cameras"]["v2 dji"].update(projection_type="fisheye", p1=0.1)), "p1 and p2"),
    ("opensfm", write("reconstruction.json", "[{"), "not valid JSON"),
]
COSTS: list[tuple[str, Edit, int, str]] = [
    ("folder", remove("depth/000003.png"), 6, ""),
    ("folder", remove("depth"), 6, ""),
    ("folder", remove("labels.json"), 6, "labels.json, which names its classes, is missing"),
    ("folder", row("poses.txt", 3, ""), 5, "line 4: is empty or a comment"),
    ("folder", row("poses.txt", 3, "# lost"), 5, "line 4: is empty or a comment"),
    ("folder", text("poses.txt", "\n", "\n\n"), 6, ""),
    ("folder", write("timestamps.txt", "1.0\n1.5\nnan\n2.5\n3.0\n3.5\n"), 5, "line 3: 'nan' is not a time"),
    ("folder", write("timestamps.txt", "timestamp\n1.0\n1.5\n2\n2.5\n3e0\n3.5\n"), 6, ""),
    ("folder", write("timestamps.txt", "1.0\n1.5\n0.5\n2.5\n3.0\n3.0\n"), 6, "go back; pictures are sorted"),
    ("folder", keys("intrinsics.json", width=None, height=None, distortion=None), 6, ""),
    ("folder", keys("intrinsics.json", axes="x forward"), 6, "not read: 'axes'"),
    ("tum", remove("depth.txt"), 6, "no depth.txt"),
    ("tum", text("rgb.txt", " rgb/", " ../rgb/", 1), 5, "outside of it"),
    ("tum", text("rgb.txt", "\n", "\r\n"), 6, ""),
    ("tum", text("groundtruth.txt", " ", "; "), 6, ""),
    ("tum", row("depth.txt", 2, "no time at all"), 6, "depth.txt, line 3"),
    ("tum", row("groundtruth.txt", 5, "1305031102.195304 nan 0 0 0 0 0 1"), 6, "groundtruth.txt, line 6"),
    ("tum", lambda f: os.truncate(f / "groundtruth.txt", 900), 4, "groundtruth.txt has no pose near its time"),
    ("folder", text("poses.txt", " ", ","), 6, ""),
    ("scannet", write("pose/20.txt", "-inf " * 16), 5, "lost track of its pose here (-inf)"),
    ("scannet", remove("pose/40.txt"), 5, "40.txt: cannot be read"),
    ("scannet", images("label-filt", np.zeros((5, 32), np.uint8)), 6, "label image is 32x5, the colour image 64x48"),
    ("scannet", remove("color/60.jpg"), 5, "1 pose left out, without a picture"),
    ("replica", remove("depth/depth_1.png"), 3, ""),
    ("replica", row("traj_w_c.txt", 2, ""), 2, "row i belongs to image i"),
    ("replica", remove("../habitat/info_semantic.json"), 3, "info_semantic.json, which names its classes"),
    ("kitti360", remove(f"data_2d_raw/{DRIVE}/image_01/timestamps.txt"), 4, "stamps are made up at 10 frames"),
    ("transforms", remove("images/frame_00002.png"), 2, "cannot be read"),
    ("transforms", frame(transform_matrix=None), 2, "required field `transform_matrix`"),
    ("transforms", frame(fl_x="wide"), 2, "1 frame left out"),
    ("transforms", frame(file_path="images/frame_00001.png"), 2, "1 picture left out, which are there twice"),
    ("transforms", frame(timestamp=3.0), 3, "not read: 'timestamp'"),
    ("transforms", keys("transforms.json", camera={"k1": 0.1, "name": "front"}), 3, "not read: 'camera'"),
    ("transforms", text("transforms.json", "images/", "images\\\\"), 3, ""),
    ("depth", remove("depths/1.png"), 3, "1 depth image left out, missing"),
    ("colmap", text(SPARSE + "images.txt", " 1.png", " ../1.png"), 2, "lies outside of it"),
    ("colmap", text(SPARSE + "images.txt", " 1.png", " " + "a" * 300 + "1.png"), 2, "without a pose in this model"),
    ("polycam", remove("keyframes/corrected_images/5000000.jpg"), 2, "1 camera left out, without a picture"),
    ("record3d", keys("metadata.json", fps=0), 3, "made up at 60"),
    ("record3d", keys("metadata.json", perFrameIntrinsicCoeffs=[[50.0, "x", 32.0, 24.0], None, 3]), 3, ""),
    ("record3d", lambda f: (f / "rgb/1.jpg").rename(f / "rgb/7.jpg"), 2, "1 pose left out, without a picture"),
    ("opensfm", shot(translation=[0, 0, None]), 3, "translation"),
    ("opensfm", shot(camera="another"), 3, "camera 'another'"),
    ("opensfm", shot("../a.jpg"), 3, "outside"),
    ("opensfm", shot(capture_time="yesterday"), 4, "made up"),
    ("opensfm", model(lambda m: {"shots": {}, "cameras": {}}), 4, "2 parts"),
]


@pytest.mark.parametrize(("kind", "edit", "says"), STOPS, ids=[f"{kind}-{says}" for kind, _, says in STOPS])
def test_what_concerns_all_frames_stops_the_import(tmp_path: Path, kind: str, edit: Edit, says: str) -> None:
    folder = MAKERS[kind](tmp_path / "made")
    edit(folder)
    with pytest.raises(ImportSourceError, match=says):
        imported(folder)
    assert not (folder.parent / "log.mcap").exists()


@pytest.mark.parametrize(("kind", "edit", "frames", "says"), COSTS, ids=[f"{c[0]}-{c[3]}" for c in COSTS])
def test_a_bad_value_costs_what_it_is_of(tmp_path: Path, kind: str, edit: Edit, frames: int, says: str) -> None:
    folder = MAKERS[kind](tmp_path / "made")
    edit(folder)
    report, kept = imported(folder)
    said = " ".join((*report.notices, *(f"{skipped.file}: {skipped.reason}" for skipped in report.skipped)))
    assert len(kept) == frames and says in said, said


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_files_with_a_byte_order_mark_are_read(tmp_path: Path, encoding: str) -> None:
    for kind, names in (("transforms", ("transforms.json",)), ("tum", ("rgb.txt", "groundtruth.txt"))):
        folder = MAKERS[kind](tmp_path / kind)
        for name in names:
            (folder / name).write_bytes((folder / name).read_text().encode(encoding))
        assert imported(folder)[1]


def test_links_of_the_users_own_are_followed(tmp_path: Path) -> None:
    folder = MAKERS["transforms"](tmp_path / "nerf")
    (folder / "images").rename(tmp_path / "far")
    (folder / "images").symlink_to(tmp_path / "far")
    assert imported(folder)[0].frames == 3


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_depth_as_numpy_writes_it_is_read(tmp_path: Path, suffix: str) -> None:
    folder = rec.make_folder(tmp_path / "kitchen")
    depth = np.full((rec.HEIGHT, rec.WIDTH), 1.25, np.float32)
    depth[0] = np.nan
    for file in (folder / "depth").iterdir():
        (np.save if suffix == ".npy" else np.savez)(file.with_suffix(suffix), depth)
        file.unlink()
    report, frames = imported(folder)
    got = frames[1].depth_m
    assert report.with_depth == 6 and got is not None and (got[0] == 0).all() and np.allclose(got[1:], 1.25)


def test_seconds_in_any_form_are_exact() -> None:
    forms = {
        "1.305031102175303936e+09": 1305031102175303936,
        "1305031102.175304": 1305031102175304000,
        "2E-3": 2_000_000,
    }
    assert {text: seconds_to_ns(text) for text in forms} == forms


def test_keys_that_change_what_numbers_mean_are_named(tmp_path: Path) -> None:
    telling = dict.fromkeys(("dist_coeffs", "radial", "K", "sensor_width", "pose_type", "is_w2c", "alpha"), 0.5)
    ordinary = {"ply_file_path": "x.ply", "sharpness": 30.0, "colmap_im_id": 3, "n_frames": 7, "aabb_scale": None}
    neutral = {"pose_rotation": np.eye(3).tolist(), "lens": [0.0], "fisheye_crop_radius": 0}
    (notice,) = unknown_notice(tmp_path, [telling | ordinary | neutral], msgspec.defstruct("Read", []))
    assert {key for key in telling | ordinary | neutral if f"'{key}'" in notice} == set(telling)
