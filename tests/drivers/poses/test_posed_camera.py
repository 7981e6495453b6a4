from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np
import pytest

from semantic_mapper.drivers.base import CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses import sources
from semantic_mapper.drivers.poses.config import FixedPose, PoseChecks
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import DevicePoseSource, FixedPoseSource
from semantic_mapper.errors import CameraError
from semantic_mapper.types import Float64

from .images import MS, ListCamera, image, rigid


class Reported(PoseSource):
    """A pose source that says what a function says."""

    def __init__(self, pose_of: Callable[[CameraImage], Float64 | None], sigma: float = 0.0) -> None:
        super().__init__()
        self.pose_of = pose_of
        self.sigma = sigma
        self.is_open = False

    def __enter__(self) -> Self:
        self.is_open = True
        return self

    def __exit__(self, *error: object) -> None:
        self.is_open = False

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        T = self.pose_of(image)
        return None if T is None else PoseEstimate(T, "reported", self.sigma)


def images(count: int, step_ms: int = 100) -> list[CameraImage]:
    return [image((i + 1) * step_ms * MS, seq=i) for i in range(count)]


def run(camera: PosedCamera) -> list[int]:
    with camera:
        return [frame.seq for frame in camera]


def test_frames_carry_the_image_and_the_pose_with_its_source_and_uncertainty() -> None:
    device = [image(7, seq=3, own=rigid((0, 0.1, 0), (1, 2, 3)))]
    camera = PosedCamera(ListCamera(device), DevicePoseSource())
    with camera:
        (frame,) = camera
    assert (frame.stamp_ns, frame.seq, frame.camera_id, frame.pose_source, frame.pose_sigma) == (
        7,
        3,
        "cam",
        "vio",
        0.01,
    )
    assert np.array_equal(frame.T_world_camera, rigid((0, 0.1, 0), (1, 2, 3))) and frame.label is None
    assert frame.rgb is device[0].rgb and frame.depth_m is device[0].depth_m
    assert camera.info.source == "list" and camera.counters["frames"] == 1


def test_an_image_without_a_pose_is_left_out_and_counted() -> None:
    camera = PosedCamera(ListCamera(images(5)), Reported(lambda i: None if i.seq in (1, 3) else np.eye(4)))
    assert run(camera) == [0, 2, 4]
    assert camera.counters == {
        "frames": 3,
        "no_pose": 2,
        "stale": 0,
        "not_rotation": 0,
        "outliers": 0,
        "uninitialized": 0,
    }


@pytest.mark.parametrize("what", ["nan", "mirror", "scale", "row", "shape", "far", "sigma", "huge sigma"])
def test_what_is_no_pose_is_left_out_and_counted(what: str) -> None:
    bad = {
        "nan": np.full((4, 4), np.nan),
        "mirror": np.diag((1.0, 1.0, -1.0, 1.0)),
        "scale": np.diag((1.1, 1.1, 1.1, 1.0)),
        "row": np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0 + np.outer((0, 0, 0, 1), (1, 0, 0, 0)),
        "shape": np.eye(3),
        "sigma": np.eye(4),
        "huge sigma": np.eye(4),
        "far": np.array([[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    }[what]
    source = Reported(lambda i: bad if i.seq == 1 else np.eye(4))
    camera = PosedCamera(ListCamera(images(3)), source)
    if "sigma" in what:
        source.sigma = np.nan if what == "sigma" else 1e300
        assert run(camera) == [] and camera.counters["not_rotation"] == 3
        return
    assert run(camera) == [0, 2]
    assert camera.counters["not_rotation"] == 1


def test_images_that_are_not_later_are_left_out_camera_by_camera() -> None:
    stream = [image(1, 0), image(1, 1), image(3, 2), image(2, 3), image(2, 4, camera_id="other"), image(4, 5)]
    camera = PosedCamera(ListCamera(stream), FixedPoseSource(FixedPose()))
    assert run(camera) == [0, 2, 4, 5]
    assert camera.counters["stale"] == 2


def test_a_jump_is_refused_and_the_frames_after_it_are_fine() -> None:
    def pose_of(i: CameraImage) -> Float64:
        return rigid(shift=(0.1 * i.seq + (5.0 if i.seq == 4 else 0.0), 0, 0))

    camera = PosedCamera(ListCamera(images(8)), Reported(pose_of))
    with camera:
        seqs = []
        for frame in camera:
            seqs.append(frame.seq)
            if frame.seq == 3:
                iterator_trouble = camera.warnings
    assert seqs == [0, 1, 2, 3, 5, 6, 7] and camera.counters["outliers"] == 1
    assert iterator_trouble == camera.warnings == ("the lens cap is on",)  # over with the next good pose


def test_limits_follow_the_time_between_images() -> None:
    checks = PoseChecks(max_speed_m_s=1.0, init_consensus=1)

    def jumps(step_ms: int, shift_m: float, turn_deg: float) -> int:
        source = Reported(lambda i: rigid((0, np.deg2rad(turn_deg) * i.seq, 0), (shift_m * i.seq, 0, 0)))
        camera = PosedCamera(ListCamera(images(2, step_ms)), source, checks)
        run(camera)
        return camera.counters["outliers"]

    # 5 cm and 3 degrees are granted in any time.
    assert jumps(100, 0.149, 0) == 0 and jumps(100, 0.151, 0) == 1
    assert jumps(500, 0.54, 0) == 0 and jumps(500, 0.56, 0) == 1
    assert jumps(100, 0, 38.9) == 0 and jumps(100, 0, 39.1) == 1


def test_after_a_jump_poses_that_agree_are_believed() -> None:
    """Odometry that has found its place again, or closed a loop."""
    source = Reported(lambda i: rigid(shift=(0.01 * i.seq + (20.0 if i.seq >= 3 else 0.0), 0, 0)))
    camera = PosedCamera(ListCamera(images(12)), source, PoseChecks(relocalize_after=4, init_consensus=2))
    assert run(camera) == [0, 1, 2, 7, 8, 9, 10, 11]
    never = PosedCamera(ListCamera(images(12)), source, PoseChecks(relocalize_after=0, init_consensus=2))
    assert run(never) == [0, 1, 2]


@pytest.mark.parametrize("far", [rigid(shift=(6.0, 0, 0)), rigid((0, 0, np.pi / 2))])
def test_a_source_that_begins_in_another_world_is_refused_until_it_comes_back(far: Float64) -> None:
    source = Reported(lambda i: (far if 8 <= i.seq < 600 else np.eye(4)) @ rigid(shift=(0.001 * i.seq, 0, 0)))
    camera = PosedCamera(ListCamera(images(610)), source)  # for a minute
    assert run(camera) == [*range(8), *range(600, 610)] and camera.counters["outliers"] == 592


def test_a_source_that_says_that_its_world_is_another_one_is_believed() -> None:
    class Restarted(Reported):
        def pose(self, image: CameraImage) -> PoseEstimate | None:
            T = self.pose_of(image)
            return None if T is None else PoseEstimate(T, "reported", world=1 if image.seq < 8 else 2)

    source = Restarted(lambda i: rigid(shift=(6.0 if i.seq >= 8 else 0.0, 0, 0)))
    with PosedCamera(ListCamera(images(16)), source) as camera:
        assert [f.world for f in camera] == [1] * 8 + [2] * 8
    with PosedCamera(ListCamera(images(9)), Reported(lambda i: np.eye(4)), begins_world=True) as camera:
        (world,) = {f.world for f in camera}
        assert world > 0


def test_one_that_was_a_little_too_quick_passes_when_it_is_within_reach() -> None:
    source = Reported(lambda i: rigid(shift=(0.4 * min(i.seq, 5), 0, 0)))  # 4 m/s; 3 are believed
    camera = PosedCamera(ListCamera(images(20)), source, PoseChecks(init_consensus=1))
    assert run(camera) == [0, *range(7, 20)]


def test_poses_that_keep_jumping_are_never_believed() -> None:
    source = Reported(lambda i: rigid(shift=(0 if i.seq < 2 else 5.0 * i.seq, 0, 0)))
    camera = PosedCamera(ListCamera(images(20)), source, PoseChecks(relocalize_after=3, init_consensus=2))
    assert run(camera) == [0, 1] and camera.counters["outliers"] == 18


@pytest.mark.parametrize("wrong", [1, 4])
def test_a_wrong_beginning_loses_against_what_follows_it(wrong: int) -> None:
    """Odometry that sends identity before it knows where it is, and then stands still far away."""
    source = Reported(lambda i: np.eye(4) if i.seq < wrong else rigid(shift=(5.0, 0, 0)))
    camera = PosedCamera(ListCamera(images(40)), source)
    assert run(camera) == [*range(wrong, 40)]
    assert camera.counters["outliers"] == wrong and camera.counters["uninitialized"] == 0


def test_first_frames_wait_for_each_other_and_none_is_lost_to_poses_that_jump_between_them() -> None:
    source = Reported(lambda i: rigid(shift=(0.01 * i.seq + (4.0 * i.seq if i.seq in (1, 3, 6) else 0.0), 0, 0)))
    device = ListCamera(images(12))
    with PosedCamera(device, source) as camera:
        frames = iter(camera)
        assert next(frames).seq == 0 and camera.counters["outliers"] == 3
        assert camera.warnings == device.warnings
        assert [frame.seq for frame in frames] == [2, 4, 5, 7, 8, 9, 10, 11]


def test_of_a_world_that_ends_before_its_poses_are_sure_nothing_is_given() -> None:
    source = Reported(lambda i: np.eye(4))
    source.pose = lambda image: PoseEstimate(np.eye(4), "reported", world=int(image.seq > 2))  # pyright: ignore
    with PosedCamera(ListCamera(images(12)), source, begins_world=True) as camera:
        frames = list(camera)
    assert [f.seq for f in frames] == list(range(3, 12)) and camera.counters["uninitialized"] == 3
    assert len({f.world for f in frames}) == 1


def test_of_two_worlds_that_take_turns_from_the_beginning_none_is_believed() -> None:
    source = Reported(lambda i: rigid(shift=(5.0 * (i.seq % 2), 0, 0)))
    camera = PosedCamera(ListCamera(images(100)), source)
    assert run(camera) == [] and camera.counters["uninitialized"] == 100
    assert "first poses do not agree" in camera.warnings[1] and "init_consensus" in camera.warnings[1]


def test_frames_of_a_recording_that_is_shorter_than_the_wait_are_given() -> None:
    assert run(PosedCamera(ListCamera(images(3)), Reported(lambda i: np.eye(4)))) == [0, 1, 2]
    contradicting = PosedCamera(ListCamera(images(2)), Reported(lambda i: rigid(shift=(5.0 * i.seq, 0, 0))))
    assert run(contradicting) == [] and contradicting.counters["uninitialized"] == 2


def test_a_pose_from_the_settings_is_believed_at_once() -> None:
    with PosedCamera(ListCamera(images(9)), FixedPoseSource(FixedPose())) as camera:
        assert next(iter(camera)).seq == 0 and camera.counters["frames"] == 1


def test_a_camera_that_stays_refused_tells_how_far_it_is_and_the_ways_out() -> None:
    source = Reported(lambda i: rigid(shift=(0.0 if i.seq < 8 else 5.0, 0, 0)))
    camera = PosedCamera(ListCamera(images(600)), source)
    assert run(camera) == [*range(8)] and camera.counters["outliers"] == 592
    (trouble,) = camera.warnings[1:]
    assert "now 5.00 m and 0 degrees from the last one that was believed, 59.2 s ago" in trouble
    assert "checks = { relocalize_after = N }" in trouble and "start the launch again" in trouble


def test_camera_and_poses_are_opened_stopped_and_freed_together() -> None:
    device, source = ListCamera(images(1)), Reported(lambda i: np.eye(4))
    camera = PosedCamera(device, source)
    with camera:
        assert device.is_open and source.is_open
        camera.stop()
        assert device.stopped
    assert not device.is_open and not source.is_open


def test_poses_are_freed_where_the_camera_does_not_open() -> None:
    class Missing(ListCamera):
        def __enter__(self) -> Self:
            raise CameraError("gone")

    source = Reported(lambda i: np.eye(4))
    with pytest.raises(CameraError, match="gone"), PosedCamera(Missing([]), source):
        pass
    assert not source.is_open


def test_the_troubles_and_counters_of_the_pose_source_are_told_too() -> None:
    camera = PosedCamera(ListCamera([image(1)]), DevicePoseSource())
    assert run(camera) == []
    assert camera.warnings[0] == "the lens cap is on" and "does not know where it is" in camera.warnings[1]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "PATIENCE_S", 2.0)


@pytest.mark.usefixtures("impatient")
def test_a_camera_that_never_gives_its_pose_is_refused_with_the_ways_out() -> None:
    camera = PosedCamera(ListCamera(images(40)), DevicePoseSource())
    with pytest.raises(CameraError, match=r"no pose of its own for 2\.1 s.*kind = \"topic\".*kind = \"board\""):
        run(camera)


@pytest.mark.usefixtures("impatient")
def test_a_device_that_was_tracked_may_be_lost_for_as_long_as_it_takes() -> None:
    stream = [image(1 * MS, 0, own=np.eye(4)), *images(40)[1:]]
    camera = PosedCamera(ListCamera(stream), DevicePoseSource())
    assert run(camera) == [0] and camera.counters["no_pose"] == 39


@pytest.mark.usefixtures("impatient")
def test_a_device_that_tracks_itself_may_take_as_long_for_its_first_pose_as_it_needs() -> None:
    quiet = [replace(unposed, tracks_itself=True) for unposed in images(40)]
    stream = [*quiet, image(5000 * MS, 40, own=np.eye(4))]
    camera = PosedCamera(ListCamera(stream), DevicePoseSource())
    assert run(camera) == [40] and camera.counters["no_pose"] == 40
    waits = PosedCamera(ListCamera(quiet), DevicePoseSource())
    assert run(waits) == [] and "does not know where it is" in waits.warnings[1]


def test_a_fixed_camera_is_where_it_is_said_to_be() -> None:
    rows = tuple(tuple(row) for row in rigid((0, 1, 0), (3, 2, 1)).tolist())
    camera = PosedCamera(ListCamera(images(2)), FixedPoseSource(FixedPose(T_world_camera=rows)))
    with camera:
        frames = list(camera)
    assert [f.pose_source for f in frames] == ["fixed", "fixed"]
    assert np.allclose(frames[1].T_world_camera, rigid((0, 1, 0), (3, 2, 1)))


class ClosingLoops(Reported):
    """Before its seventh image it finds out that the world is two metres further to the right."""

    motion = rigid(shift=(2, 0, 0))

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        if self.seq != 6:
            return None
        return CorrectedWorld({(i + 1) * 100 * MS: self.motion for i in range(6)}, 600 * MS, self.motion)

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        self.seq = image.seq
        return super().pose(image)


def test_a_closed_loop_is_no_jump_and_is_handed_on_as_poses_of_the_camera() -> None:
    mount = rigid(shift=(0, 0, 0.5))
    source = ClosingLoops(lambda i: np.eye(4) if i.seq < 6 else ClosingLoops.motion)
    given: list[tuple[int, CorrectedWorld | None]] = []
    with PosedCamera(ListCamera(images(9)), source, T_rig_camera=mount) as camera:
        for frame in camera:
            given.append((frame.seq, camera.correction()))
    assert [seq for seq, _ in given] == list(range(9))
    (corrected,) = (c for _, c in given if c is not None)
    assert given[6][1] is corrected and corrected.until_ns == 600 * MS
    assert np.allclose(corrected.poses[100 * MS], ClosingLoops.motion @ mount)
    assert camera.correction(final=True) is None
