"""Collections of posed pictures: transforms.json, COLMAP models, Polycam, Record3D."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, look_at
from semantic_mapper.replay.importers import ImportOptions, ImportReport, detect_format, import_recording
from semantic_mapper.replay.log.reader import LogReader
from semantic_mapper.replay.sfm.colmap_model import read_model
from semantic_mapper.types import Float64, PosedFrame

W, H, F = 64, 48, 50.0
GL = np.diag((1.0, -1.0, -1.0, 1.0))


def poses(count: int = 3) -> list[Float64]:
    """A camera at 1.5 m that looks level along x, and walks to its right; z is up."""
    eye = np.array((0.0, 0.0, 1.5))
    step = np.array((0.0, -0.2, 0.0))
    return [look_at(eye + n * step, eye + n * step + (2.0, 0.1 * n, 0.0), np.eye(3)[2]) for n in range(count)]


def write_pictures(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for n, name in enumerate(names):
        picture = np.full((H, W, 3), (40 * n + 20) % 256, np.uint8)
        picture[H // 2 :, W // 4] = (0, 0, 255)
        assert cv2.imwrite(str(folder / name), picture)


def imported(src: Path, **options: Any) -> tuple[ImportReport, list[PosedFrame]]:
    dst = src.parent / "log.mcap"
    report = import_recording(src, dst, options=ImportOptions(**options), overwrite=True)
    with LogReader(dst) as log:
        return report, list(log)


def make_transforms(folder: Path, form: str = "frame_{:05d}.png", count: int = 3, **more: Any) -> Path:
    write_pictures(folder / "images", [form.format(n + 1) for n in range(count)])
    frames = [
        {"file_path": f"images/{form.format(n + 1)}", "transform_matrix": (T @ GL).tolist()}
        for n, T in enumerate(poses(count))
    ]
    given = {"fl_x": F, "fl_y": F, "cx": W / 2, "cy": H / 2, "w": W, "h": H, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(given))
    return folder


def test_poses_of_transforms_json_change_axes_and_keep_their_unit(tmp_path: Path) -> None:
    report, frames = imported(make_transforms(tmp_path / "nerf"))
    assert (report.format, report.frames, report.info.scale_known) == ("transforms", 3, False)
    assert "stamps are made up at 2 frames a second" in report.notices[0] and "scale is unknown" in report.notices[1]
    for frame, T in zip(frames, poses(), strict=True):
        assert np.allclose(frame.T_world_camera, T, atol=1e-12)
        assert (frame.intrinsics.fx, frame.intrinsics.cx, frame.intrinsics.cy) == (F, 31.5, 23.5)


def test_a_given_scale_makes_metres(tmp_path: Path) -> None:
    report, frames = imported(make_transforms(tmp_path / "nerf"), scale=2.5)
    assert report.info.scale_known
    assert np.allclose(frames[2].T_world_camera[:3, 3], 2.5 * poses()[2][:3, 3])


def test_numbers_in_names_order_the_frames(tmp_path: Path) -> None:
    _, frames = imported(make_transforms(tmp_path / "nerf", "frame_{}.png", 11))
    for frame, T in zip(frames, poses(11), strict=True):
        assert np.allclose(frame.T_world_camera, T, atol=1e-12) and frame.stamp_ns == 500_000_000 * frame.seq


def add_depth(folder: Path) -> Path:
    """Depth images of half the size: 1.5 m and a millimetre more in each frame, without measurement above."""
    (folder / "depths").mkdir()
    found = json.loads((folder / "transforms.json").read_text())
    for n, frame in enumerate(found["frames"]):
        units = np.full((H // 2, W // 2), 1500 + n, np.uint16)
        units[: H // 4] = 0
        cv2.imwrite(str(folder / "depths" / f"{n}.png"), units)
        frame["depth_file_path"] = f"depths/{n}.png"
    (folder / "transforms.json").write_text(json.dumps(found))
    return folder


@pytest.mark.parametrize("k1", [0.0, 0.3])
def test_depth_of_transforms_json_is_read_and_makes_its_poses_metric(tmp_path: Path, k1: float) -> None:
    report, frames = imported(add_depth(make_transforms(tmp_path / "nerf", k1=k1)))
    assert report.info.scale_known and report.with_depth == 3 and "stamps are made up" in report.notices[0]
    depth = frames[1].depth_m
    assert depth is not None and np.allclose(depth[H // 2 + 1 :], 1.501) and (depth[: H // 2 - 1] == 0).all()


def test_depth_follows_its_picture_when_the_lens_is_undone(tmp_path: Path) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf", k1=0.5))
    picture, units = np.zeros((H, W, 3), np.uint8), np.full((H, W), 3000, np.uint16)
    picture[8:20, 6:18], units[8:20, 6:18] = 255, 1000
    cv2.imwrite(str(folder / "images" / "frame_00001.png"), picture)
    cv2.imwrite(str(folder / "depths" / "0.png"), units)
    frame = imported(folder)[1][0]
    assert frame.depth_m is not None
    white = frame.rgb[..., 0] > 127
    assert (white != (picture[..., 0] > 127)).sum() > 40  # the square has moved
    assert (white != (frame.depth_m < 2)).sum() < 30  # its depth with it, but for some of its edge


def test_depth_images_that_are_missing_are_told_and_make_nothing_metric(tmp_path: Path) -> None:
    folder = add_depth(make_transforms(tmp_path / "nerf"))
    (folder / "depths" / "1.png").unlink()
    report, frames = imported(folder)
    assert report.info.scale_known and report.with_depth == 2 and frames[1].depth_m is None
    assert "1 of 3 depth images are missing" in " ".join(report.notices)
    for n in (0, 2):
        (folder / "depths" / f"{n}.png").unlink()
    report, _ = imported(folder)
    assert not report.info.scale_known and "3 of 3 depth images are missing" in " ".join(report.notices)


def test_a_scale_makes_metres_of_poses_and_leaves_depth_alone(tmp_path: Path) -> None:
    report, frames = imported(add_depth(make_transforms(tmp_path / "nerf")), scale=2.0)
    assert frames[1].depth_m is not None and frames[1].depth_m.max() == pytest.approx(1.501)
    assert np.allclose(frames[2].T_world_camera[:3, 3], 2 * poses()[2][:3, 3])
    assert "depth images keep their own unit" in " ".join(report.notices)
    with pytest.raises(ImportSourceError, match="in metres"):
        imported(make_record3d(tmp_path / "phone"), scale=2.0)


def test_a_field_of_view_names_without_suffix_and_a_lens_are_understood(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf", k1=-0.2)
    found = json.loads((folder / "transforms.json").read_text())
    for name in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del found[name]
    found["camera_angle_x"] = 2 * np.arctan(W / 2 / F)
    for frame in found["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    (folder / "transforms.json").write_text(json.dumps(found))
    _, frames = imported(folder)
    assert not frames[0].intrinsics.distortion and frames[0].intrinsics.fx != pytest.approx(F)  # rectified


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "'EQUIRECTANGULAR' is not undone"),
        ({"k4": 0.01}, "no k4 that programs agree on"),
        ({"is_fisheye": True, "p1": 0.01}, "has no p1"),
        ({"from_mitsuba": True}, "'from_mitsuba' means poses in other axes"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"frames": []}, "no posed picture"),
        ({"frames": [{"file_path": "../a.png", "transform_matrix": np.eye(4).tolist()}]}, "outside"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[1.0]]}]}, "transform_matrix"),
        ({"frames": 3}, "frames"),
    ],
)
def test_what_is_wrong_with_transforms_json_is_told(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ImportSourceError, match=says):
        imported(make_transforms(tmp_path / "nerf", **changes))


def test_a_missing_picture_is_left_out(tmp_path: Path) -> None:
    folder = make_transforms(tmp_path / "nerf")
    (folder / "images" / "frame_00002.png").unlink()
    report, frames = imported(folder)
    assert [frame.seq for frame in frames] == [0, 2] and "cannot be read" in report.skipped[0].reason


def quaternion(R: Float64) -> tuple[float, float, float, float]:
    """w x y z of a rotation."""
    values, vectors = np.linalg.eigh(
        np.array(
            [
                [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
                [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
                [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
                [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
            ]
        )
    )
    x, y, z, w = vectors[:, int(np.argmax(values))]
    return float(w), float(x), float(y), float(z)


POINTS = np.array([(2.0, -0.3, 1.4), (2.5, 0.4, 1.7), (1.8, 0.0, 1.2)])


def make_colmap(folder: Path, kind: str) -> Path:
    """A model as COLMAP writes it, with the pictures beside it."""
    write_pictures(folder / "images", [f"{n}.png" for n in range(3)])
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    if kind == "txt":
        (sparse / "cameras.txt").write_text(f"# Camera list\n1 SIMPLE_RADIAL {W} {H} {F} {W / 2} {H / 2} 0\n")
        rows = []
        for n, T in enumerate(poses()):
            pose = invert_pose(T)
            numbers = (*quaternion(pose[:3, :3]), *pose[:3, 3])
            rows.append(f"{n + 1} {' '.join(map(repr, map(float, numbers)))} 1 {n}.png")
            rows.append(" ".join(f"{10.5 + k} 20.5 {k + 1}" for k in range(3)) if n else "")
        (sparse / "images.txt").write_text("# Image list\n" + "\n".join(rows) + "\n")
        lines = [f"{k + 1} {x} {y} {z} 1 2 3 0.5 2 {k}" for k, (x, y, z) in enumerate(POINTS)]
        (sparse / "points3D.txt").write_text("\n".join(lines) + "\n")
        return folder
    with (sparse / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<QiiQQ4d", 1, 1, 2, W, H, F, W / 2, H / 2, 0.0))
    with (sparse / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", 3))
        for n, T in enumerate(poses()):
            pose = invert_pose(T)
            file.write(struct.pack("<i7di", n + 1, *quaternion(pose[:3, :3]), *pose[:3, 3], 1))
            file.write(f"{n}.png".encode() + b"\0")
            features = [(10.5 + k, 20.5, k + 1) for k in range(3)] if n else []
            file.write(struct.pack("<Q", len(features)))
            for feature in features:
                file.write(struct.pack("<ddq", *feature))
    with (sparse / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(POINTS)))
        for k, xyz in enumerate(POINTS):
            file.write(struct.pack("<Q3d3BdQii", k + 1, *xyz, 1, 2, 3, 0.5, 1, 2, k))
    return folder


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_a_colmap_model_is_imported_upright(tmp_path: Path, kind: str) -> None:
    folder = make_colmap(tmp_path / "scan", kind)
    report, frames = imported(folder, scale=2.0)
    assert (report.format, report.frames, report.info.scale_known) == ("colmap", 3, True)
    moved = [frame.T_world_camera for frame in frames]
    for T, true in zip(moved, poses(), strict=True):
        assert np.allclose(T[:3, 1], (0, 0, -1), atol=1e-9)  # image down is down
        assert np.allclose(T[:3, 3] - moved[0][:3, 3], 2 * (true[:3, 3] - poses()[0][:3, 3]), atol=1e-9)
    assert (frames[0].intrinsics.fx, frames[0].intrinsics.cx) == (F, 31.5)


def test_images_of_a_model_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "txt")
    images = folder / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(" 0.png", " 10.png"))
    assert [image.name for image in read_model(images.parent).images] == ["1.png", "2.png", "10.png"]


@pytest.mark.parametrize("kind", ["txt", "bin"])
def test_both_forms_of_a_model_are_read_alike(tmp_path: Path, kind: str) -> None:
    model = read_model(make_colmap(tmp_path / "scan", kind) / "sparse" / "0")
    assert [image.name for image in model.images] == ["0.png", "1.png", "2.png"]
    assert np.allclose(model.images[1].T_world_camera, poses()[1], atol=1e-9)
    assert np.allclose(model.images[1].xy, [(10, 20), (11, 20), (12, 20)]) and len(model.images[0].xy) == 0
    assert np.allclose(model.points[2], POINTS[1]) and model.errors_px[2] == 0.5


def test_a_colmap_model_without_scale_says_so_and_is_made_of_room_size(tmp_path: Path) -> None:
    report, frames = imported(make_colmap(tmp_path / "scan", "bin"))
    assert not report.info.scale_known
    depths = [(POINTS - T[:3, 3]) @ T[:3, 2] for T in poses()[1:]]
    factor = 2.0 / np.median(depths)
    step = np.linalg.norm(frames[1].T_world_camera[:3, 3] - frames[0].T_world_camera[:3, 3])
    assert step == pytest.approx(0.2 * factor)


def test_what_is_wrong_with_a_colmap_model_is_told(tmp_path: Path) -> None:
    folder = make_colmap(tmp_path / "scan", "bin")
    images = folder / "sparse" / "0" / "images.bin"
    images.write_bytes(images.read_bytes()[:-5])
    with pytest.raises(ImportSourceError, match="cut off"):
        imported(folder)
    folder = make_colmap(tmp_path / "text", "txt")
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(f"1 FOV {W} {H} {F} {F} 32 24 0.5\n")
    with pytest.raises(ImportSourceError, match="lens model 'FOV' is not read"):
        imported(folder)
    cameras.write_text(f"2 PINHOLE {W} {H} {F} {F} 32 24\n")
    with pytest.raises(ImportSourceError, match="camera 1, which is missing"):
        imported(folder)
    for picture in (folder / "images").iterdir():
        picture.unlink()
    cameras.write_text(f"1 PINHOLE {W} {H} {F} {F} 32 24\n")
    with pytest.raises(ImportSourceError, match="pictures of the model are missing"):
        imported(folder)


def arkit(T: Float64) -> Float64:
    """Camera to world as ARKit has it, of a pose in a world with z up."""
    T_y_up = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return T_y_up @ T @ GL


def make_polycam(folder: Path) -> Path:
    """A capture with corrected pictures and poses, a quarter second apart."""
    names = [str(5_000_000 + 250_000 * n) for n in range(3)]
    for kind in ("images", "corrected_images"):
        write_pictures(folder / "keyframes" / kind, [f"{name}.jpg" for name in names])
    for kind in ("cameras", "corrected_cameras", "depth", "confidence"):
        (folder / "keyframes" / kind).mkdir()
    for name, T in zip(names, poses(), strict=True):
        matrix = arkit(T)
        camera = {f"t_{i}{j}": float(matrix[i, j]) for i in range(3) for j in range(4)}
        camera |= {"fx": F, "fy": F, "cx": W / 2, "cy": H / 2, "width": W, "height": H, "blur_score": 90.0}
        (folder / "keyframes" / "corrected_cameras" / f"{name}.json").write_text(json.dumps(camera))
        confidence = np.full((H // 4, W // 4), 255, np.uint8)
        confidence[:, 0] = 0
        cv2.imwrite(str(folder / "keyframes" / "depth" / f"{name}.png"), np.full((H // 4, W // 4), 1250, np.uint16))
        cv2.imwrite(str(folder / "keyframes" / "confidence" / f"{name}.png"), confidence)
    return folder


def test_polycam_raw_data_come_with_poses_times_and_trusted_depth(tmp_path: Path) -> None:
    report, frames = imported(make_polycam(tmp_path / "capture"))
    assert (report.format, report.with_depth, report.info.scale_known) == ("polycam", 3, True)
    for n, (frame, T) in enumerate(zip(frames, poses(), strict=True)):
        assert np.allclose(frame.T_world_camera, T, atol=1e-9) and frame.stamp_ns == 250_000_000 * n
        assert frame.depth_m is not None and frame.depth_m.shape == (H, W)
        assert (frame.depth_m[:, :4] == 0).all() and np.allclose(frame.depth_m[:, 4:], 1.25)


def make_record3d(folder: Path, **changes: Any) -> Path:
    write_pictures(folder / "rgb", [f"{n}.jpg" for n in range(3)])
    rows = []
    for T in poses():
        w, x, y, z = quaternion(arkit(T)[:3, :3])
        rows.append([x, y, z, w, *arkit(T)[:3, 3].tolist()])
    given = {"w": W, "h": H, "fps": 4, "K": [F, 0, 0, 0, F, 0, W / 2, H / 2, 1], "poses": rows}
    (folder / "metadata.json").write_text(json.dumps({**given, **changes}))
    return folder


def test_a_record3d_export_comes_with_poses_and_times(tmp_path: Path) -> None:
    report, frames = imported(make_record3d(tmp_path / "phone"))
    assert (report.format, report.frames, report.info.scale_known) == ("record3d", 3, True)
    for n, (frame, T) in enumerate(zip(frames, poses(), strict=True)):
        assert np.allclose(frame.T_world_camera, T, atol=1e-9) and frame.stamp_ns == 250_000_000 * n
        assert (frame.intrinsics.cx, frame.intrinsics.cy) == (31.5, 23.5)


@pytest.mark.parametrize(
    ("changes", "says"),
    [({"poses": []}, "pose of none"), ({"poses": [[2.0] * 7] * 3}, "no unit quaternion"), ({"K": [1]}, "K")],
)
def test_what_is_wrong_with_a_record3d_export_is_told(tmp_path: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ImportSourceError, match=says):
        imported(make_record3d(tmp_path / "phone", **changes))


def test_collections_are_told_apart(tmp_path: Path) -> None:
    assert detect_format(make_transforms(tmp_path / "a")) == "transforms"
    assert detect_format(make_colmap(tmp_path / "b", "txt")) == "colmap"
    assert detect_format(make_record3d(tmp_path / "c")) == "record3d"
