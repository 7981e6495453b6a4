from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose
from semantic_mapper.replay.importers import ImportOptions, ImportReport, detect_format, import_recording
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.small import tiny_frames

from . import bags
from .bags import CAMERA, COLOR, DEPTH, INFO, Event, Kind, Messages

KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
FRAMES = tiny_frames(6)


def make(
    folder: Path,
    kind: Kind,
    change: Callable[[Messages, list[Event]], Sequence[Event]] = lambda _, events: events,
    frames: Sequence[PosedFrame] = FRAMES,
) -> Path:
    folder.mkdir(exist_ok=True)
    m = Messages(kind)
    return bags.write_bag(folder / "bag", kind, change(m, bags.room_events(m, frames)))


def imported(src: Path, **options: Any) -> tuple[ImportReport, list[PosedFrame]]:
    dst = src.parent / "log.mcap"
    report = import_recording(src, dst, options=ImportOptions(**options), overwrite=True)
    with LogReader(dst) as log:
        return report, list(log)


def without(*topics: str) -> Callable[[Messages, list[Event]], list[Event]]:
    return lambda _, events: [event for event in events if event[0] not in topics]


def notice(report: ImportReport, words: str) -> bool:
    return any(words in text for text in report.notices)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_either_version_gives_the_same_pictures_depth_and_poses(tmp_path: Path, kind: Kind) -> None:
    src = make(tmp_path, kind)
    assert detect_format(src) == "rosbag"
    report, frames = imported(src)
    assert (report.format, report.frames, report.with_depth, report.skipped) == ("rosbag", 6, 6, ())
    assert report.info.frame_hz == 10.0 and notice(report, f"poses are those of {CAMERA} in map, from tf")
    for n, (frame, truth) in enumerate(zip(frames, FRAMES, strict=True)):
        assert frame.stamp_ns == bags.stamp_of(n) and frame.intrinsics == truth.intrinsics
        assert np.array_equal(frame.rgb, truth.rgb)
        assert frame.depth_m is not None
        assert np.array_equal(frame.depth_m, bags.millimetres(truth).astype(np.float32) / np.float32(1000))
        assert np.abs(frame.T_world_camera - truth.T_world_camera).max() < 1e-6


def test_a_storage_file_is_a_bag_too_and_a_folder_whose_metadata_is_missing(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap")
    (file,) = src.glob("*.mcap")
    assert detect_format(file) == "rosbag"
    assert import_recording(file, tmp_path / "file.mcap").frames == 6
    (src / "metadata.yaml").unlink()
    assert imported(src)[0].frames == 6


def test_poses_between_two_transforms_are_interpolated_and_beyond_them_there_are_none(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        """Odometry turns and moves evenly, and is told 30 ms off the images; the last image comes after its end."""
        kept = [event for event in events if event[0] != "/tf"]
        for k in range(-1, 6):
            ns = bags.START_NS + k * bags.PERIOD_NS + 30_000_000
            kept.append(("/tf", ns, m.tf(ns, "odom", "base_link", even(ns))))
        return kept

    def even(ns: int) -> np.ndarray:
        s = (ns - bags.START_NS) / 1e9
        T = np.eye(4)
        T[:2, :2] = ((np.cos(0.7 * s), -np.sin(0.7 * s)), (np.sin(0.7 * s), np.cos(0.7 * s)))
        T[:3, 3] = (0.5 * s, -0.1 * s, 0)
        return T

    src = make(tmp_path, "ros1", change, tiny_frames(7))
    report, frames = imported(src)
    assert len(frames) == 6 and "no pose round its time" in report.skipped[0].reason
    for n, frame in enumerate(frames):
        assert np.abs(frame.T_world_camera - even(bags.stamp_of(n)) @ bags.camera_on_base()).max() < 1e-6


def test_over_a_long_gap_of_tf_nothing_is_interpolated(tmp_path: Path) -> None:
    def change(_: Messages, events: list[Event]) -> list[Event]:
        return [e for e in events if e[0] != "/tf" or not bags.stamp_of(1) <= e[1] < bags.stamp_of(12)]

    frames = [FRAMES[n % 6] for n in range(14)]
    report, kept = imported(make(tmp_path, "sqlite3", change, frames))
    assert [frame.stamp_ns for frame in kept] == [bags.stamp_of(n) for n in (0, 12, 13)] and len(report.skipped) == 11


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_odometry_gives_poses_where_tf_has_no_world(tmp_path: Path, kind: Kind) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] != "/tf"]
        for n, T in enumerate(bags.bodies(FRAMES)):
            kept.append(("/odom", bags.stamp_of(n), m.odometry(bags.stamp_of(n), T, "base_link")))
        return kept

    report, frames = imported(make(tmp_path, kind, change))
    assert notice(report, "from /odom of base_link")
    for frame, T_odom_base in zip(frames, bags.bodies(FRAMES), strict=True):
        assert np.abs(frame.T_world_camera - T_odom_base @ bags.camera_on_base()).max() < 1e-6


def test_poses_that_do_not_say_whose_they_are_need_a_body(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if not event[0].startswith("/tf")]
        for n, frame in enumerate(FRAMES):
            kept.append(("/mocap", bags.stamp_of(n), m.pose_stamped(bags.stamp_of(n), frame.T_world_camera)))
        return kept

    src = make(tmp_path, "mcap", change)
    with pytest.raises(ImportSourceError, match=rf"/mocap does not say whose poses.*--body {CAMERA}"):
        imported(src)
    _, frames = imported(src, body=CAMERA)
    assert np.abs(frames[3].T_world_camera - FRAMES[3].T_world_camera).max() < 1e-6
    with pytest.raises(ImportSourceError, match=r"tells where 'helmet' is, but tf does not say where the camera"):
        imported(src, body="helmet")


BGR = FRAMES[0].rgb[..., ::-1]


def mosaic(order: str) -> np.ndarray:
    """What a Bayer sensor sees of a picture in which each pixel has the same colour."""
    flat = {"r": 200, "g": 120, "b": 40}
    tile = np.array([[flat[order[0]], flat[order[1]]], [flat[order[2]], flat[order[3]]]], np.uint8)
    return np.tile(tile, (36, 48))


def yuv(code: int) -> np.ndarray:
    return np.asarray(cv2.cvtColor(FRAMES[0].rgb, code), np.uint8)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("bgr8", BGR, FRAMES[0].rgb),
        ("rgba8", np.dstack((FRAMES[0].rgb, np.full((72, 96), 9, np.uint8))), FRAMES[0].rgb),
        ("mono8", FRAMES[0].rgb[..., 1], np.repeat(FRAMES[0].rgb[..., 1:2], 3, axis=2)),
        *(
            (f"bayer_{order}8", mosaic(order), np.full((72, 96, 3), (200, 120, 40), np.uint8))
            for order in ("rggb", "bggr", "gbrg", "grbg")
        ),
    ],
)
def test_raw_encodings_become_rgb(tmp_path: Path, encoding: str, pixels: np.ndarray, expected: np.ndarray) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        """With bytes between the rows, as drivers align them."""
        image = m.image(bags.START_NS, CAMERA, pixels, encoding, padding=5)
        return [e if e[0] != COLOR else (COLOR, e[1], image) for e in events if e[1] < bags.stamp_of(1)]

    _, frames = imported(make(tmp_path, "ros1", change))
    assert np.array_equal(frames[0].rgb, expected)


@pytest.mark.parametrize(
    ("encoding", "code"), [("yuv422", cv2.COLOR_RGB2YUV_UYVY), ("yuv422_yuy2", cv2.COLOR_RGB2YUV_YUY2)]
)
def test_yuv_becomes_rgb_again_but_for_the_halved_colour(tmp_path: Path, encoding: str, code: int) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        image = m.image(bags.START_NS, CAMERA, yuv(code), encoding)
        return [e if e[0] != COLOR else (COLOR, e[1], image) for e in events if e[1] < bags.stamp_of(1)]

    _, frames = imported(make(tmp_path, "sqlite3", change))
    off = np.abs(frames[0].rgb.astype(int) - FRAMES[0].rgb)
    assert float(np.median(off)) <= 3 and float(off.mean()) < 8


def test_compressed_images_stay_the_files_that_they_are(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", BGR, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] not in (COLOR, DEPTH)]
        for n, frame in enumerate(FRAMES):
            ns = bags.stamp_of(n)
            image = m.compressed(ns, CAMERA, "rgb8; jpeg compressed bgr8", jpeg)
            data = bags.compressed_depth(bags.millimetres(frame))
            depth = m.compressed(ns, CAMERA, "16UC1; compressedDepth png", data)
            kept += [(f"{COLOR}/compressed", ns, image), (f"{DEPTH}/compressedDepth", ns, depth)]
        return kept

    src = make(tmp_path, "mcap", change)
    report, frames = imported(src)
    assert report.with_depth == 6
    with LogReader(tmp_path / "log.mcap") as log:
        assert [parts[2] for _, parts in log.frame_parts()] == [jpeg] * 6
    assert frames[5].depth_m is not None
    assert np.array_equal(np.rint(frames[5].depth_m * 1000), bags.millimetres(FRAMES[5]))


@pytest.mark.parametrize("form", ["32FC1", "big endian", "32FC1; compressedDepth png"])
def test_depth_may_be_metres_in_floats_or_of_the_other_byte_order(tmp_path: Path, form: str) -> None:
    metres = np.array(FRAMES[0].depth_m)
    metres[3, 4], metres[5, 6] = np.nan, np.inf

    def message(m: Messages) -> Any:
        if form == "32FC1":
            return m.image(bags.START_NS, CAMERA, metres, "32FC1")
        if form == "big endian":
            return m.image(bags.START_NS, CAMERA, bags.millimetres(FRAMES[0]).astype(">u2"), "16UC1")
        # Inverse depth as image_transport quantises it: value = A / depth + B.
        a, b = 100.0 * 101.0, 1.0 - 100.0 * 101.0 / 10.0
        with np.errstate(invalid="ignore"):
            values = np.where(np.isfinite(metres), a / metres + b, 0).astype(np.uint16)
        data = bags.struct.pack("<iff", 0, a, b) + bags.png(values)
        return m.compressed(bags.START_NS, CAMERA, form, data)

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [e for e in events if e[0] != DEPTH and e[1] < bags.stamp_of(1)]
        return [*kept, (DEPTH + ("/compressedDepth" if "compressed" in form else ""), bags.START_NS, message(m))]

    _, frames = imported(make(tmp_path, "mcap", change))
    depth = frames[0].depth_m
    assert depth is not None
    if form != "big endian":
        assert depth[3, 4] == 0 and depth[5, 6] == 0
    good = np.isfinite(metres) & (metres > 0)
    if form == "32FC1":
        assert np.array_equal(depth[good], metres[good])
    else:
        worst = np.abs(depth[good] - metres[good]).max()
        assert worst < (0.0006 if form == "big endian" else 0.02)


def test_lens_distortion_is_removed_from_colour_and_depth(tmp_path: Path) -> None:
    lens = (-0.15, 0.03, 0.001, -0.001, 0.0)

    def change(m: Messages, events: list[Event]) -> list[Event]:
        info = m.info(bags.START_NS, CAMERA, FRAMES[0].intrinsics, lens=lens)
        return [(t, ns, info) if t in (INFO, bags.DEPTH_INFO) else (t, ns, message) for t, ns, message in events]

    _, frames = imported(make(tmp_path, "mcap", change))
    rectify = Rectifier(dataclasses.replace(FRAMES[0].intrinsics, distortion=lens))
    assert frames[0].intrinsics == rectify.intrinsics != FRAMES[0].intrinsics
    assert np.array_equal(frames[0].rgb, rectify(np.ascontiguousarray(BGR)))
    metres = (bags.millimetres(FRAMES[0]) / np.float32(1000)).astype(np.float32)
    assert np.array_equal(frames[0].depth_m, rectify.nearest(metres))
    assert (frames[0].depth_m == 0).mean() < 0.01


def test_depth_of_another_camera_is_registered_by_tf(tmp_path: Path) -> None:
    """A depth camera with half of the pixels, 3 cm aside, looks at a wall 2 m away that is nearer on the right."""
    own = CameraIntrinsics(33.0, 33.0, 23.5, 17.5, 48, 36)
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = 0.03
    depth = np.full((36, 48), 2000, np.uint16)
    depth[:, 30:] = 1500

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] not in (DEPTH, bags.DEPTH_INFO)]
        kept.append(("/tf_static", bags.START_NS + 1, m.tf(bags.START_NS, CAMERA, "depth", T_color_depth)))
        for n in range(6):
            ns = bags.stamp_of(n)
            kept.append(("/cam/depth/image_rect_raw", ns, m.image(ns, "depth", depth, "16UC1")))
            kept.append(("/cam/depth/camera_info", ns, m.info(ns, "depth", own)))
        return kept

    report, frames = imported(make(tmp_path, "ros1", change))
    assert notice(report, "/cam/depth/image_rect_raw is registered to /cam/color/image_raw")
    got = frames[0].depth_m
    assert got is not None and set(np.unique(got).tolist()) == {0.0, 1.5, 2.0}
    # Column u of depth goes to 2 u + 0.5 + 66 * 0.03 / z of colour: two pixels further at 1.5 m, one at 2 m.
    rows = got[got.any(axis=1)]
    far, near = (np.flatnonzero((rows == z).any(axis=0)) for z in (2.0, 1.5))
    assert far.max() == round(2 * 29 + 0.5 + 66 * 0.03 / 2) and near.min() == round(2 * 30 + 0.5 + 66 * 0.03 / 1.5)

    def unlinked(m: Messages, events: list[Event]) -> list[Event]:
        return [event for event in change(m, events) if event[1] != bags.START_NS + 1]

    with pytest.raises(ImportSourceError, match=r"another camera .depth. than .* --topic depth=none"):
        imported(make(tmp_path / "unlinked", "ros1", unlinked))


def two_cameras(m: Messages, events: list[Event]) -> list[Event]:
    doubled = [(topic.replace("/cam/", "/rear/"), ns, message) for topic, ns, message in events if "/cam/" in topic]
    return [*events, *doubled]


def test_of_two_cameras_one_has_to_be_named(tmp_path: Path) -> None:
    src = make(tmp_path, "sqlite3", two_cameras)
    with pytest.raises(ImportSourceError, match=r"several topics fit the image: /cam/color/image_raw \(rgb8\), /rear/"):
        imported(src)
    with pytest.raises(ImportSourceError, match=r"several topics fit the depth"):
        imported(src, topics={"image": COLOR})
    report, frames = imported(src, topics={"image": COLOR, "depth": "none"})
    assert report.with_depth == 0 and np.array_equal(frames[1].rgb, FRAMES[1].rgb)
    assert imported(src, topics={"image": "/rear/color/image_raw", "depth": DEPTH})[0].with_depth == 6
    with pytest.raises(ImportSourceError, match=r"no topic '/side' of images for image; there are /cam"):
        imported(src, topics={"image": "/side"})
    with pytest.raises(
        ImportSourceError, match=r"no topic has the role 'rgb'; the roles are image, depth, info, depth_info, pose"
    ):
        imported(src, topics={"rgb": COLOR})


def test_colour_goes_before_the_grey_images_of_a_stereo_pair(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        grey = m.image(bags.START_NS, "infra", FRAMES[0].rgb[..., 0], "mono8")
        return [*events, ("/cam/infra1/image_rect_raw", bags.START_NS, grey)]

    report, _ = imported(make(tmp_path, "mcap", change))
    assert report.frames == 6 and notice(report, "there are also /cam/infra1/image_rect_raw (mono8)")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (without(INFO, bags.DEPTH_INFO), "no camera_info at /cam/color/camera_info.*there is none"),
        (without("/tf", "/tf_static"), "has no poses: neither tf nor a topic of nav_msgs/Odometry"),
        (without("/tf_static"), f"tf does not know the frame '{CAMERA}'.*--topic pose=NAME"),
        (without(COLOR, DEPTH), "no topic has images; there are /cam/aligned"),
        (
            without("/tf"),
            f"tf has no frame map, world, odom above the camera: '{CAMERA}' on 'base_link'; .*--world base",
        ),
    ],
)
def test_what_a_bag_lacks_is_named(
    tmp_path: Path, change: Callable[[Messages, list[Event]], list[Event]], complaint: str
) -> None:
    with pytest.raises(ImportSourceError, match=complaint):
        imported(make(tmp_path, "mcap", change))


def test_a_lens_that_is_not_opencvs_and_a_camera_without_calibration_are_refused(tmp_path: Path) -> None:
    for name, model, lens, focal, complaint in (
        ("fish", "thin_prism_fisheye", (0.1, 0, 0, 0), 66.0, "'thin_prism_fisheye' is not undone.*rectify the images"),
        ("blank", "plumb_bob", (0,) * 5, 0.0, "is not calibrated .K is zero."),
    ):

        def change(
            m: Messages, events: list[Event], model: str = model, lens: Any = lens, f: float = focal
        ) -> list[Event]:
            info = m.info(bags.START_NS, CAMERA, FRAMES[0].intrinsics, model, lens)
            if not f:
                (info.k if not m.ros1 else info.K)[:] = 0
            return [(t, ns, info if t == INFO else message) for t, ns, message in events]

        with pytest.raises(ImportSourceError, match=complaint):
            imported(make(tmp_path / name, "ros1", change))


def test_a_frame_on_two_others_is_refused(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        return [*events, ("/tf", bags.START_NS, m.tf(bags.START_NS, "map", "base_link", np.eye(4)))]

    with pytest.raises(ImportSourceError, match=r"'base_link' sits on map and on odom"):
        imported(make(tmp_path, "mcap", change))


def test_a_world_may_be_named(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap")
    _, frames = imported(src, world="/odom")
    expected = invert_pose(bags.odom_in_map()) @ FRAMES[2].T_world_camera
    assert np.abs(frames[2].T_world_camera - expected).max() < 1e-6
    with pytest.raises(
        ImportSourceError, match=r"no way from .* to earth: 'camera_color_optical_frame' on 'base_link'"
    ):
        imported(src, world="earth")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.98])
def test_a_bag_that_is_cut_off_is_refused_with_what_mends_it(tmp_path: Path, kind: Kind, keep: float) -> None:
    src = make(tmp_path, kind)
    file = src if kind == "ros1" else next(f for f in src.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * keep)])
    with pytest.raises(ImportSourceError, match=r"(cannot be read.*reindex|no topic has images)"):
        imported(src)
    assert not (tmp_path / "log.mcap").exists()


def test_an_image_that_does_not_fit_its_size_costs_that_frame_alone(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        short = m.image(bags.stamp_of(2), CAMERA, FRAMES[2].rgb, "rgb8")
        short.height = 73
        other = m.image(bags.stamp_of(4), CAMERA, FRAMES[4].rgb[:40], "rgb8")
        swap = {bags.stamp_of(2) + 5_000_000: short, bags.stamp_of(4) + 5_000_000: other}
        return [(t, ns, swap.get(ns, message) if t == COLOR else message) for t, ns, message in events]

    report, frames = imported(make(tmp_path, "ros1", change))
    assert [frame.seq for frame in frames] == [0, 1, 3, 5]
    assert np.array_equal(frames[3].rgb, FRAMES[5].rgb)
    said = {skipped.frame: skipped.reason for skipped in report.skipped}
    assert "96x73 with 288 bytes a row does not fit" in said[2] and "the image is 96x40" in said[4]


def test_frames_may_be_asked_for_in_any_order(tmp_path: Path) -> None:
    from semantic_mapper.replay.importers.rosbag import RosbagRecording

    recording = RosbagRecording(make(tmp_path, "mcap"), ImportOptions())
    for n in (4, 1, 5, 0, 0, 3):
        assert np.array_equal(recording.load(n).frame.rgb, FRAMES[n].rgb)
