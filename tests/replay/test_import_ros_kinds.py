"""Bags as robots record them: transforms of two sources, calibrations that drift, messages without stamp or frame."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.importers.ros_transforms import Track

from . import bags
from .bags import CAMERA, COLOR, DEPTH, INFO, Event, Messages
from .test_import_rosbag import FRAMES, imported, make, notice

LONG = [FRAMES[0]] * 8  # of a robot that stands still
MS = 1_000_000
Change = Callable[[Messages, list[Event]], list[Event]]


def aside(T: np.ndarray, metres: float) -> np.ndarray:
    T = T.copy()
    T[1, 3] += metres
    return T


def second_source(topic: str, metres: float, later_ns: int = 5 * MS) -> Change:
    """The robot's odometry again, on a topic, from one who sees it elsewhere."""

    def change(m: Messages, events: list[Event]) -> list[Event]:
        told = list(events)
        for n, T in enumerate(bags.bodies(LONG)):
            ns = bags.stamp_of(n) + later_ns
            told.append((topic, ns, m.tf(ns, "odom", "base_link", aside(T, metres))))
        return told

    return change


def test_two_programs_that_publish_one_transform_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportSourceError, match=r"'base_link' on 'odom' jumps to and fro by 0\.5 m.*--topic pose=NAME"):
        imported(make(tmp_path / "one", "mcap", second_source("/tf", 0.5), LONG))
    assert imported(make(tmp_path / "two", "mcap", second_source("/tf", 0.0), LONG))[0].frames == 8

    # Of ROS 1 the nodes are known, whatever their rates.
    with pytest.raises(ImportSourceError, match=r"'base_link' on 'odom' is told by /tf and, otherwise, by /tf of /ekf"):
        imported(make(tmp_path / "three", "ros1", second_source("/tf@/ekf", 0.1, 0), LONG))
    src = make(tmp_path / "again", "ros1", second_source("/tf@/ekf", 0.1, bags.PERIOD_NS * 8), LONG)
    assert imported(src)[0].frames == 8  # it was started after the first had ended


def test_two_sources_of_a_transform_do_no_harm_where_another_topic_tells_the_poses(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        events = second_source("/tf", 0.5)(m, events)
        odometry = [
            ("/odom", bags.stamp_of(n), m.odometry(bags.stamp_of(n), T, "base_link"))
            for n, T in enumerate(bags.bodies(LONG))
        ]
        return [*events, *odometry]

    _, frames = imported(make(tmp_path, "mcap", change, LONG), topics={"pose": "/odom"})
    assert np.abs(frames[3].T_world_camera - bags.bodies(LONG)[3] @ bags.camera_on_base()).max() < 1e-6


def test_of_two_robots_with_equal_frames_the_one_of_the_images_counts(tmp_path: Path) -> None:
    def robots(camera: str) -> Change:
        def change(m: Messages, events: list[Event]) -> list[Event]:
            own: list[Event] = []
            for topic, ns, message in events:
                topic = f"/r1{topic}" if topic.startswith("/tf") else topic.replace("/cam/", f"{camera}/")
                own.append((topic, ns, message))
            return second_source("/r2/tf", 5.0)(m, own)

        return change

    report, frames = imported(make(tmp_path / "own", "mcap", robots("/r1/cam"), LONG))
    assert notice(report, "transforms of /r2/tf are left out: /r1/cam/color/image_raw is not in its namespace")
    assert np.abs(frames[3].T_world_camera - LONG[3].T_world_camera).max() < 1e-6
    with pytest.raises(ImportSourceError, match=r"is told by /r1/tf and, otherwise, by /r2/tf: record the true one"):
        imported(make(tmp_path / "none", "mcap", robots("/cam"), LONG))


@pytest.mark.parametrize(
    ("topic", "complaint"),
    [
        ("/tf_static", r"/tf_static says first \(0\.200, 0\.050, 0\.900\) m.*then \(0\.200, 0\.550, .*: cut the bag"),
        ("/tf", r"is told by /tf_static and, otherwise, by /tf: record the true one"),
    ],
)
def test_two_places_of_the_camera_are_refused(tmp_path: Path, topic: str, complaint: str) -> None:
    def told(metres: float) -> Change:
        def change(m: Messages, events: list[Event]) -> list[Event]:
            at = m.tf(bags.stamp_of(1), "base_link", CAMERA, aside(bags.camera_on_base(), metres))
            return [*events, (topic, bags.stamp_of(1), at)]

        return change

    with pytest.raises(ImportSourceError, match=rf"'{CAMERA}' on 'base_link' .*{complaint}"):
        imported(make(tmp_path / "two", "ros1", told(0.5)))
    within = imported(make(tmp_path / "one", "ros1", told(0.0005)), match_s=1.0)
    assert within[0].frames == 6


def track(stamps: np.ndarray, places: np.ndarray, yaw: np.ndarray) -> Track:
    """Of places (N, 2) in metres and headings in radians, at times in seconds."""
    turned = Rotation.from_rotvec(np.outer(yaw, (0, 0, 1))).as_quat()
    rows = np.hstack((places, np.zeros((len(places), 1)), turned))
    return Track([round(t * 1e9) for t in stamps], [tuple(row) for row in rows.tolist()])


def walk(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A robot that drives at 1 m/s on a circle of 2 m."""
    return np.stack((2 * np.sin(t / 2), 2 - 2 * np.cos(t / 2)), 1), t / 2


@pytest.mark.parametrize(("first_hz", "second_hz"), [(10, 10), (30, 50), (10, 30)])
@pytest.mark.parametrize("aside_m", [0.1, 0.5])
def test_two_sources_are_told_apart_at_any_rates(first_hz: int, second_hz: int, aside_m: float) -> None:
    a, b = np.arange(0, 30, 1 / first_hz), np.arange(0.003, 30, 1 / second_hz)
    t = np.sort(np.append(a, b))
    places, yaw = walk(t)
    places[:, 1] += aside_m * np.isin(t, b)
    places += np.random.default_rng(0).normal(0, 0.001, places.shape)
    assert aside_m / 2 < track(t, places, yaw).jump_m() < 1.5 * aside_m


def test_a_second_source_that_drifts_away_is_seen_although_it_began_well() -> None:
    t = np.arange(0, 60, 0.05)
    places, yaw = walk(t)
    places[1::2, 1] += 0.01 * t[1::2]
    assert track(t, places, yaw).jump_m() > 0


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


@pytest.mark.parametrize("lens", [(0.0,) * 5, (-0.15, 0.03, 0.001, -0.001, 0.0)])
def test_each_image_has_the_calibration_of_its_time(tmp_path: Path, lens: tuple[float, ...]) -> None:
    """An autofocus moves the centre by 0.08 px an image; what differs by less than 0.1 px is one calibration."""
    true = [dataclasses.replace(FRAMES[0].intrinsics, cx=FRAMES[0].intrinsics.cx + 0.08 * n) for n in range(6)]

    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] not in (INFO, bags.DEPTH_INFO)]
        for n, k in enumerate(true):
            ns = bags.stamp_of(n)
            kept += [(topic, ns, m.info(ns, CAMERA, k, lens=lens)) for topic in (INFO, bags.DEPTH_INFO)]
        return kept

    report, frames = imported(make(tmp_path, "mcap", change))
    assert notice(
        report, "the calibration of /cam/color/image_raw changes a little: each image has the nearest in time"
    )
    for n, frame in enumerate(frames):
        rectify = Rectifier(dataclasses.replace(true[n - n % 2], distortion=lens if any(lens) else ()))
        assert frame.intrinsics == rectify.intrinsics
        assert np.array_equal(frame.rgb, rectify(np.ascontiguousarray(FRAMES[n].rgb[..., ::-1])))
        metres = (bags.millimetres(FRAMES[n]) / np.float32(1000)).astype(np.float32)
        assert frame.depth_m is not None and np.array_equal(frame.depth_m, rectify.nearest(metres))


def of(topic: str, events: list[Event]) -> list[Any]:
    return [message for name, _, message in events if name == topic]


def empty(message: Any) -> None:
    message.encoding, message.height, message.width, message.step = "", 0, 0, 0
    message.data = np.zeros(0, np.uint8)


@pytest.mark.parametrize(
    ("unnamed", "whose"), [(slice(0, 1), "a later image"), (slice(None), INFO)], ids=["first", "all"]
)
def test_images_without_a_frame_get_that_of_a_later_one_or_of_their_calibration(
    tmp_path: Path, unnamed: slice, whose: str
) -> None:
    def change(_: Messages, events: list[Event]) -> list[Event]:
        for topic in (COLOR, DEPTH):
            for message in of(topic, events)[unnamed]:
                message.header.frame_id = ""
        return events

    report, frames = imported(make(tmp_path, "ros1", change))
    assert report.with_depth == 6 and notice(report, f"names no frame; '{CAMERA}' of {whose} is taken")
    assert np.abs(frames[3].T_world_camera - FRAMES[3].T_world_camera).max() < 1e-6


@pytest.mark.parametrize("topic", [COLOR, DEPTH])
def test_a_first_message_without_data_costs_its_frame_alone(tmp_path: Path, topic: str) -> None:
    def change(_: Messages, events: list[Event]) -> list[Event]:
        empty(of(topic, events)[0])
        return events

    report, frames = imported(make(tmp_path, "sqlite3", change))
    assert [frame.seq for frame in frames] == [1, 2, 3, 4, 5] and report.with_depth == 5
    assert "encoding '' are not read" in report.skipped[0].reason


def test_a_calibration_with_nan_in_its_lens_is_passed_over(tmp_path: Path) -> None:
    def change(_: Messages, events: list[Event]) -> list[Event]:
        of(INFO, events)[3].d = np.full(5, np.nan)
        return events

    report, _ = imported(make(tmp_path, "mcap", change))
    assert report.frames == 6 and notice(report, f"{INFO}: 1 message without a calibration passed over")


@pytest.mark.parametrize("kind", ["tf", "odometry", "pose"])
def test_poses_without_stamps_have_the_time_of_their_receipt(tmp_path: Path, kind: str) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        if kind == "tf":
            for message in of("/tf", events):
                for stamped in message.transforms:
                    stamped.header = m.header(0, stamped.header.frame_id)
            return events
        kept = [event for event in events if event[0] != "/tf"]
        for n, T in enumerate(bags.bodies(FRAMES)):
            message = m.odometry(0, T, "base_link") if kind == "odometry" else m.pose_stamped(0, T)
            kept.append(("/pose", bags.stamp_of(n), message))
        return kept

    report, frames = imported(make(tmp_path, "ros1", change), body="" if kind != "pose" else "base_link")
    named = "tf of 'base_link'" if kind == "tf" else "/pose"
    assert notice(report, f"{named}: 6 poses without a stamp; the time of receipt stands for it")
    T_world_odom = bags.odom_in_map() if kind == "tf" else np.eye(4)
    for frame, T in zip(frames, bags.bodies(FRAMES), strict=True):
        assert np.abs(frame.T_world_camera - T_world_odom @ T @ bags.camera_on_base()).max() < 1e-6


def test_a_simulated_clock_begins_at_zero(tmp_path: Path) -> None:
    """What was recorded by the computer's clock then has stamps from 0 on."""

    def change(m: Messages, events: list[Event]) -> list[Event]:
        made: list[Event] = [event for event in events if event[0] == "/tf_static"]
        for n, (frame, T) in enumerate(zip(FRAMES, bags.bodies(FRAMES), strict=True)):
            ns, received_ns = n * bags.PERIOD_NS, bags.stamp_of(n)
            made += [
                ("/tf", received_ns, m.tf(ns, "odom", "base_link", T)),
                (INFO, received_ns, m.info(ns, CAMERA, frame.intrinsics)),
                (COLOR, received_ns, m.image(ns, CAMERA, frame.rgb, "rgb8")),
            ]
        return made

    report, frames = imported(make(tmp_path, "mcap", change))
    assert not notice(report, "stamp") and [frame.stamp_ns for frame in frames] == [
        n * bags.PERIOD_NS for n in range(6)
    ]
    for frame, T in zip(frames, bags.bodies(FRAMES), strict=True):
        assert np.abs(frame.T_world_camera - T @ bags.camera_on_base()).max() < 1e-6


def test_a_path_is_named_as_what_is_not_read(tmp_path: Path) -> None:
    def change(m: Messages, events: list[Event]) -> list[Event]:
        kept = [event for event in events if event[0] != "/tf"]
        return [*kept, ("/path", bags.START_NS, m.make("nav_msgs/Path", m.header(bags.START_NS, "odom"), []))]

    missing = "nothing tells how 'base_link' moves: record tf or odometry (/path, a nav_msgs/Path, is not read)"
    with pytest.raises(ImportSourceError, match=re.escape(missing)):
        imported(make(tmp_path / "static", "mcap", change))
    with pytest.raises(ImportSourceError, match=r"has no poses.*\(/path, a nav_msgs/Path, is not read\)"):
        imported(make(tmp_path / "alone", "mcap", lambda m, e: [x for x in change(m, e) if x[0] != "/tf_static"]))
