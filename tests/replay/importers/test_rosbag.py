"""ROS bags of both versions, as robots record them: right values, and what cannot be true."""

import dataclasses
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zstandard
from scipy.spatial.transform import Rotation

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers.ros_transforms import Track
from semantic_mapper.replay.importers.run import detect_format, needs_import
from semantic_mapper.replay.log.format import LogReader
from semantic_mapper.types import CameraIntrinsics, PosedFrame
from tests.replay import bags
from tests.replay.bags import CAMERA, COLOR, DEPTH, DEPTH_INFO, INFO, Event, Kind, Messages
from tests.replay.recordings import imported, said
from tests.small import tiny_frames

KINDS: tuple[Kind, ...] = ("ros1", "sqlite3", "mcap")
FRAMES = tiny_frames(6)
LONG = [FRAMES[0]] * 8  # of a robot that stands still
MS = 1_000_000
Change = Callable[[Messages, list[Event]], list[Event]]


def make(
    folder: Path,
    kind: Kind,
    change: Callable[[Messages, list[Event]], Sequence[Event]] = lambda _, events: events,
    frames: Sequence[PosedFrame] = FRAMES,
) -> Path:
    folder.mkdir(exist_ok=True)
    m = Messages(kind)
    return bags.write_bag(folder / "bag", kind, change(m, bags.room_events(m, frames)))


def without(*topics: str) -> Change:
    return lambda _, events: [event for event in events if event[0] not in topics]


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_either_version_gives_the_same_pictures_depth_and_poses(tmp_path: Path, kind: Kind) -> None:
    src = make(tmp_path, kind)
    assert detect_format(src) == "rosbag"
    report, frames = imported(src)
    assert (report.format, report.frames, report.with_depth, report.skipped) == ("rosbag", 6, 6, [])
    assert report.info.frame_hz == 10.0 and f"poses are those of {CAMERA} in map, from tf" in said(report)
    for n, (frame, truth) in enumerate(zip(frames, FRAMES, strict=True)):
        assert frame.stamp_ns == bags.stamp_of(n) and frame.intrinsics == truth.intrinsics
        assert np.array_equal(frame.rgb, truth.rgb)
        assert frame.depth_m is not None
        assert np.array_equal(frame.depth_m, bags.millimetres(truth).astype(np.float32) / np.float32(1000))
        assert np.abs(frame.T_world_camera - truth.T_world_camera).max() < 1e-6


def test_poses_between_two_transforms_are_interpolated_and_beyond_them_there_are_none(tmp_path: Path) -> None:
    def even(ns: int) -> np.ndarray:
        s = (ns - bags.START_NS) / 1e9
        T = np.eye(4)
        T[:2, :2] = ((np.cos(0.7 * s), -np.sin(0.7 * s)), (np.sin(0.7 * s), np.cos(0.7 * s)))
        T[:3, 3] = (0.5 * s, -0.1 * s, 0)
        return T

    def change(m: Messages, events: list[Event]) -> list[Event]:
        """Odometry turns and moves evenly, and is sent 30 ms off the images; the last image comes after its end."""
        times = [bags.stamp_of(k) + 30 * MS for k in range(-1, 6)]
        return [*without("/tf")(m, events), *(("/tf", ns, m.tf(ns, "odom", "base_link", even(ns))) for ns in times)]

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


def test_poses_that_do_not_say_whose_they_are_need_a_body(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        poses = [(bags.stamp_of(n), frame.T_world_camera) for n, frame in enumerate(FRAMES)]
        return [*without("/tf", "/tf_static")(m, events), *(("/mocap", ns, m.pose_stamped(ns, T)) for ns, T in poses)]

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


def test_compressed_images_stay_the_files_that_they_are(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", BGR, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = without(COLOR, DEPTH)(m, events)
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
        data = struct.pack("<iff", 0, a, b) + bags.png(values)
        return m.compressed(bags.START_NS, CAMERA, form, data)

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [e for e in events if e[0] != DEPTH and e[1] < bags.stamp_of(1)]
        return [*kept, (DEPTH + ("/compressedDepth" if "compressed" in form else ""), bags.START_NS, message(m))]

    _, frames = imported(make(tmp_path, "mcap", change))
    depth, good = frames[0].depth_m, np.isfinite(metres) & (metres > 0)
    assert depth is not None
    if form != "big endian":
        assert depth[3, 4] == 0 and depth[5, 6] == 0
    worst = {"32FC1": 0, "big endian": 0.0006, "32FC1; compressedDepth png": 0.02}[form]
    assert np.abs(depth[good] - metres[good]).max() <= worst


def test_lens_distortion_is_removed_from_colour_and_depth(tmp_path: Path) -> None:
    lens = (-0.15, 0.03, 0.001, -0.001, 0.0)

    def change(m: Messages, events: list[Event]) -> list[Event]:
        info = m.info(bags.START_NS, CAMERA, FRAMES[0].intrinsics, lens=lens)
        return [(t, ns, info) if t in (INFO, DEPTH_INFO) else (t, ns, message) for t, ns, message in events]

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
        tf = ("/tf_static", bags.START_NS + 1, m.tf(bags.START_NS, CAMERA, "depth", T_color_depth))
        times = [bags.stamp_of(n) for n in range(6)]
        images = [("/cam/depth/image_rect_raw", ns, m.image(ns, "depth", depth, "16UC1")) for ns in times]
        infos = [("/cam/depth/camera_info", ns, m.info(ns, "depth", own)) for ns in times]
        return [*without(DEPTH, DEPTH_INFO)(m, events), tf, *images, *infos]

    report, frames = imported(make(tmp_path, "ros1", change))
    assert "/cam/depth/image_rect_raw is registered to /cam/color/image_raw" in said(report)
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
    for topics, complaint in (
        ({}, r"several topics fit the image: /cam/color/image_raw \(rgb8\), /rear/"),
        ({"image": COLOR}, r"several topics fit the depth"),
        ({"image": "/side"}, r"no topic '/side' fits the image; there are /cam"),
        ({"rgb": COLOR}, r"no topic has the role 'rgb'; the roles are image, depth, info, depth_info, pose"),
    ):
        with pytest.raises(ImportSourceError, match=complaint):
            imported(src, topics=topics)
    report, frames = imported(src, topics={"image": COLOR, "depth": "none"})
    assert report.with_depth == 0 and np.array_equal(frames[1].rgb, FRAMES[1].rgb)
    assert imported(src, topics={"image": "/rear/color/image_raw", "depth": DEPTH})[0].with_depth == 6


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (without(INFO, DEPTH_INFO), "no camera_info at /cam/color/camera_info.*the bag has no such topic"),
        (without("/tf", "/tf_static"), "has no poses: neither tf nor a topic of nav_msgs/Odometry"),
        (without("/tf_static"), f"tf does not know the frame '{CAMERA}'.*--topic pose=NAME"),
        (without(COLOR, DEPTH), "no topic has images; there are /cam/aligned"),
        (
            without("/tf"),
            f"tf has no frame map, world, odom above the camera: '{CAMERA}' on 'base_link'; .*still: --world base",
        ),
    ],
)
def test_what_a_bag_lacks_is_named(tmp_path: Path, change: Change, complaint: str) -> None:
    with pytest.raises(ImportSourceError, match=complaint):
        imported(make(tmp_path, "mcap", change))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0.0, 0.001, 0.5, 0.98])
def test_a_bag_that_is_cut_off_is_refused_with_what_mends_it(tmp_path: Path, kind: Kind, keep: float) -> None:
    src = make(tmp_path, kind)
    file = src if kind == "ros1" else next(f for f in src.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * keep)])
    with pytest.raises(ImportSourceError, match=r"(cannot be read.*reindex|no topic has images)"):
        imported(src)
    assert not (tmp_path / "log.mcap").exists()


def aside(T: np.ndarray, metres: float) -> np.ndarray:
    T = T.copy()
    T[1, 3] += metres
    return T


def second_source(topic: str, metres: float, later_ns: int = 5 * MS) -> Change:
    """The robot's odometry again, on a topic, from one who sees it elsewhere."""

    def change(m: Messages, events: list[Event]) -> list[Event]:
        told = [(bags.stamp_of(n) + later_ns, aside(T, metres)) for n, T in enumerate(bags.bodies(LONG))]
        return [*events, *((topic, ns, m.tf(ns, "odom", "base_link", T)) for ns, T in told)]

    return change


def test_two_programs_that_publish_one_transform_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportSourceError, match=r"'base_link' on 'odom' jumps to and fro by 0\.5 m.*--topic pose=NAME"):
        imported(make(tmp_path / "one", "mcap", second_source("/tf", 0.5), LONG))
    assert imported(make(tmp_path / "two", "mcap", second_source("/tf", 0.0), LONG))[0].frames == 8

    # Of ROS 1 the nodes are known, whatever their rates.
    with pytest.raises(ImportSourceError, match=r"'base_link' on 'odom' is published by /tf and.* by /tf of /ekf"):
        imported(make(tmp_path / "three", "ros1", second_source("/tf@/ekf", 0.1, 0), LONG))
    src = make(tmp_path / "again", "ros1", second_source("/tf@/ekf", 0.1, bags.PERIOD_NS * 8), LONG)
    assert imported(src)[0].frames == 8  # it was started after the first had ended


@pytest.mark.parametrize(
    ("topic", "complaint"),
    [
        ("/tf_static", r"published by /tf_static and, otherwise, by /tf_static: .*cut the bag"),
        ("/tf", r"is published by /tf_static and, otherwise, by /tf: record the true one"),
    ],
)
def test_two_places_of_the_camera_are_refused(tmp_path: Path, topic: str, complaint: str) -> None:
    def told(metres: float) -> Change:
        T, times = aside(bags.camera_on_base(), metres), [bags.stamp_of(n) for n in range(6)]
        return lambda m, events: [*events, *((topic, ns, m.tf(ns, "base_link", CAMERA, T)) for ns in times)]

    with pytest.raises(ImportSourceError, match=rf"'{CAMERA}' on 'base_link' .*{complaint}"):
        imported(make(tmp_path / "two", "ros1", told(0.5)))
    assert imported(make(tmp_path / "one", "ros1", told(0.0005)))[0].frames == 6


def track(stamps: np.ndarray, places: np.ndarray, yaw: np.ndarray) -> Track:
    """Of places (N, 2) in metres and headings in radians, at times in seconds."""
    turned = Rotation.from_rotvec(np.outer(yaw, (0, 0, 1))).as_quat()
    rows = np.hstack((places, np.zeros((len(places), 1)), turned))
    return Track([round(t * 1e9) for t in stamps], [tuple(row) for row in rows.tolist()])


def walk(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A robot that drives at 1 m/s on a circle of 2 m."""
    return np.stack((2 * np.sin(t / 2), 2 - 2 * np.cos(t / 2)), 1), t / 2


def test_one_source_is_never_taken_for_two() -> None:
    rng = np.random.default_rng(1)
    for count in (6, 12, 13, 40, 80, 3000):
        t = np.arange(count) * 0.1
        places, yaw = walk(t)
        still, none = np.zeros((count, 2)), np.zeros(count)
        cases = {
            "still": (t, still, none),
            "driving": (t, places, yaw),
            "noise on a line": (t, still + rng.normal(0, 0.1, (count, 1)) * (1, 0), none),
            "noise": (t, places + rng.normal(0, 0.1, (count, 2)), yaw + rng.normal(0, 0.05, count)),
            "late stamps": (t + rng.uniform(0, 0.09, count), 3 * t[:, None] * (1, 0), none),
            "steps of the encoder": (t, np.round(places, 2), yaw),
            "loop closures": (t, places + 0.8 * (t // 1.7 % 2)[:, None], yaw),
            "each pose twice": (t, np.repeat(places, 2, axis=0)[:count] * 3, np.repeat(yaw, 2)[:count]),
            "each pose three times": (t, np.repeat(places, 3, axis=0)[:count] * 3, np.repeat(yaw, 3)[:count]),
            "told again": (np.repeat(t, 2)[:count], np.repeat(places, 2, axis=0)[:count], np.repeat(yaw, 2)[:count]),
            "a sway of 2 Hz": (t, places + 0.05 * np.sin(4 * np.pi * t)[:, None], yaw),
        }
        assert {name: track(*case).jump_m() for name, case in cases.items()} == dict.fromkeys(cases, 0.0), count


def of(topic: str, events: list[Event]) -> list[Any]:
    return [message for name, _, message in events if name == topic]


@pytest.mark.parametrize("unnamed", [slice(0, 1), slice(None)], ids=["first", "all"])
def test_images_without_a_frame_get_that_of_a_later_one_or_of_their_calibration(tmp_path: Path, unnamed: slice) -> None:
    def change(_: Messages, events: list[Event]) -> list[Event]:
        for topic in (COLOR, DEPTH):
            for message in of(topic, events)[unnamed]:
                message.header.frame_id = ""
        return events

    report, frames = imported(make(tmp_path, "ros1", change))
    assert report.with_depth == 6
    assert np.abs(frames[3].T_world_camera - FRAMES[3].T_world_camera).max() < 1e-6


@pytest.mark.parametrize("kind", ["tf", "odometry", "pose"])
def test_poses_without_stamps_have_the_time_of_their_receipt(tmp_path: Path, kind: str) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        if kind == "tf":
            for message in of("/tf", events):
                for stamped in message.transforms:
                    stamped.header = m.header(0, stamped.header.frame_id)
            return events
        poses = [(m.odometry(0, T, "base_link"), m.pose_stamped(0, T)) for T in bags.bodies(FRAMES)]
        told = [("/pose", bags.stamp_of(n), found[kind == "pose"]) for n, found in enumerate(poses)]
        return [*without("/tf")(m, events), *told]

    report, frames = imported(make(tmp_path, "ros1", change), body="" if kind != "pose" else "base_link")
    named = "tf of 'base_link'" if kind == "tf" else "/pose"
    assert f"{named}: 6 messages without a stamp; the time of receipt stands for it" in said(report)
    T_world_odom = bags.odom_in_map() if kind == "tf" else np.eye(4)
    for frame, T in zip(frames, bags.bodies(FRAMES), strict=True):
        assert np.abs(frame.T_world_camera - T_world_odom @ T @ bags.camera_on_base()).max() < 1e-6


def test_a_simulated_clock_begins_at_zero(tmp_path: Path) -> None:
    """What was recorded by the computer's clock then has stamps from 0 on."""

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] == "/tf_static"]
        for n, (frame, T) in enumerate(zip(FRAMES, bags.bodies(FRAMES), strict=True)):
            ns, received_ns = n * bags.PERIOD_NS, bags.stamp_of(n)
            kept.append(("/tf", received_ns, m.tf(ns, "odom", "base_link", T)))
            kept.append((INFO, received_ns, m.info(ns, CAMERA, frame.intrinsics)))
            kept.append((COLOR, received_ns, m.image(ns, CAMERA, frame.rgb, "rgb8")))
        return kept

    report, frames = imported(make(tmp_path, "mcap", change))
    assert "stamp" not in said(report)
    assert [frame.stamp_ns for frame in frames] == [n * bags.PERIOD_NS for n in range(6)]
    for frame, T in zip(frames, bags.bodies(FRAMES), strict=True):
        assert np.abs(frame.T_world_camera - T @ bags.camera_on_base()).max() < 1e-6


def without_profile(bag: bytes) -> bytes:
    data = bytearray(bag)  # magic, op code, length, length of the profile, and "ros2"
    assert data[17:25] == struct.pack("<I4s", 4, b"ros2")
    data[17:29] = struct.pack("<II4s", 0, int.from_bytes(data[25:29], "little") + 4, b"any ")
    return bytes(data)


@pytest.mark.parametrize(
    ("kind", "name", "changed"),
    [
        ("mcap", "merged.mcap", without_profile),
        ("sqlite3", "day.db3.zstd", zstandard.ZstdCompressor().compress),
        ("mcap", "day.zstd", zstandard.ZstdCompressor().compress),
    ],
)
def test_bags_are_known_by_their_content(
    tmp_path: Path, kind: Kind, name: str, changed: Callable[[bytes], bytes]
) -> None:
    file = next(f for f in make(tmp_path, kind).iterdir() if f.suffix != ".yaml")
    (tmp_path / name).write_bytes(changed(file.read_bytes()))
    assert detect_format(tmp_path / name) == "rosbag" and needs_import(tmp_path / name)
    report, frames = imported(tmp_path / name)
    assert report.frames == 6 and np.array_equal(frames[3].rgb, FRAMES[3].rgb)


def other_lens(topic: str) -> Change:
    k = FRAMES[0].intrinsics
    k = dataclasses.replace(k, fx=0.9 * k.fx, fy=0.9 * k.fy)
    return lambda m, events: [*without(topic)(m, events), (topic, bags.START_NS, m.info(bags.START_NS, CAMERA, k))]


def test_another_lens_of_the_same_camera_frame_is_asked_about(tmp_path: Path) -> None:
    src = make(tmp_path, "mcap", other_lens(DEPTH_INFO))
    with pytest.raises(ImportSourceError, match=rf"other intrinsics.*--topic depth_info={INFO}"):
        imported(src)
    _, frames = imported(src, topics={"depth_info": INFO})
    assert frames[0].depth_m is not None
    assert np.array_equal(frames[0].depth_m, bags.millimetres(FRAMES[0]).astype(np.float32) / np.float32(1000))
    _, warped = imported(src, topics={"depth_info": DEPTH_INFO})
    assert warped[0].depth_m is not None and not np.array_equal(warped[0].depth_m, frames[0].depth_m)
    src = make(tmp_path / "two", "mcap", other_lens("/camera/rgb/camera_info"))
    with pytest.raises(ImportSourceError, match=rf"two calibrations.*--topic info={INFO}"):
        imported(src)
    assert imported(src, topics={"info": INFO})[1][0].intrinsics == FRAMES[0].intrinsics


def test_clocks_that_differ_are_named_with_both_ranges(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = without("/tf")(m, events)
        return [*kept, *(("/tf", bags.stamp_of(n), m.tf(10**9 * n, "odom", "base_link", np.eye(4))) for n in range(3))]

    with pytest.raises(
        ImportSourceError, match=r"images of .* are from .*'odom' to 'base_link'. from 0.000 to 2.000 s"
    ):
        imported(make(tmp_path, "mcap", change))
