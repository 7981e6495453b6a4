from collections.abc import Callable
from dataclasses import replace
from typing import Self

import numpy as np
import pytest

from semantic_mapper.drivers.base import CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import FixedPose, PoseChecks
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import DevicePoseSource, FixedPoseSource
from semantic_mapper.errors import CameraError
from semantic_mapper.types import Float64

from .images import MS, ListCamera, image, rigid


class Reported(PoseSource):
    """A pose source that says what functions of the image say."""

    def __init__(
        self,
        pose_of: Callable[[CameraImage], Float64],
        sigma: float = 0.0,
        world_of: Callable[[CameraImage], int] = lambda image: 0,
    ) -> None:
        super().__init__()
        self.pose_of = pose_of
        self.sigma = sigma
        self.world_of = world_of
        self.is_open = False

    def __enter__(self) -> Self:
        self.is_open = True
        return self

    def __exit__(self, *error: object) -> None:
        self.is_open = False

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        return PoseEstimate(self.pose_of(image), "reported", self.sigma, self.world_of(image))


def images(count: int, step_ms: int = 100) -> list[CameraImage]:
    return [image((i + 1) * step_ms * MS, seq=i) for i in range(count)]


def moving(x_of: Callable[[int], float], count: int) -> PosedCamera:
    """A camera whose x is a function of the number of its image."""
    return PosedCamera(ListCamera(images(count)), Reported(lambda i: rigid(shift=(x_of(i.seq), 0, 0))))


def run(camera: PosedCamera) -> list[int]:
    with camera:
        return [frame.seq for frame in camera]


def test_frames_carry_the_image_and_the_pose_with_its_source_and_uncertainty() -> None:
    device = [image(7, seq=3, own=rigid((0, 0.1, 0), (1, 2, 3)))]
    with PosedCamera(ListCamera(device), DevicePoseSource()) as camera:
        (frame,) = camera
    assert (frame.stamp_ns, frame.seq, frame.camera_id) == (7, 3, "cam")
    assert (frame.pose_source, frame.pose_sigma) == ("vio", 0.01)
    assert np.array_equal(frame.T_world_camera, rigid((0, 0.1, 0), (1, 2, 3))) and frame.label is None
    assert frame.rgb is device[0].rgb and frame.depth_m is device[0].depth_m
    assert camera.info.source == "list" and camera.counters["frames"] == 1
    rows = tuple(tuple(row) for row in rigid((0, 1, 0), (3, 2, 1)).tolist())
    with PosedCamera(ListCamera(images(9)), FixedPoseSource(FixedPose(T_world_camera=rows))) as camera:
        first = next(iter(camera))  # a pose of the settings is believed at once
    assert (first.seq, first.pose_source) == (0, "fixed") and camera.counters["frames"] == 1
    assert np.allclose(first.T_world_camera, rigid((0, 1, 0), (3, 2, 1)))


@pytest.mark.parametrize(
    ("bad", "sigma"),
    [
        (np.full((4, 4), np.nan), 0.0),
        (np.diag((1.0, 1.0, -1.0, 1.0)), 0.0),
        (np.diag((1.1, 1.1, 1.1, 1.0)), 0.0),
        (np.eye(3), 0.0),
        (rigid(shift=(1e9, 0, 0)), 0.0),
        (np.eye(4), np.nan),
        (np.eye(4), 1e300),
    ],
)
def test_what_is_no_pose_is_left_out_and_counted(bad: Float64, sigma: float) -> None:
    camera = PosedCamera(ListCamera(images(3)), Reported(lambda i: bad, sigma))
    assert run(camera) == [] and camera.counters["not_rotation"] == 3


def test_images_that_are_not_later_are_left_out_camera_by_camera() -> None:
    stream = [image(1, 0), image(1, 1), image(3, 2), image(2, 3), image(2, 4, camera_id="other"), image(4, 5)]
    camera = PosedCamera(ListCamera(stream), FixedPoseSource(FixedPose()))
    assert run(camera) == [0, 2, 4, 5]
    assert camera.counters["stale"] == 2


def test_a_jump_is_refused_and_the_frames_after_it_are_fine() -> None:
    camera = moving(lambda seq: 0.1 * seq + (5.0 if seq == 6 else 0.0), 9)
    assert run(camera) == [0, 1, 2, 3, 4, 5, 7, 8] and camera.counters["outliers"] == 1
    quick = moving(lambda seq: 0.4 * min(max(seq - 4, 0), 5), 24)  # 4 m/s; 3 are believed
    assert run(quick) == [*range(5), *range(11, 24)], "it passes when it is within reach"
    assert camera.warnings == ("the lens cap is on",)  # over with the next good pose


@pytest.mark.parametrize(("step_ms", "shift_m", "turn_deg"), [(100, 0.15, 0), (500, 0.55, 0), (100, 0, 39)])
def test_limits_follow_the_time_between_images(step_ms: int, shift_m: float, turn_deg: float) -> None:
    """5 cm and 3 degrees are granted in any time."""
    for times, jumps in ((0.99, 0), (1.01, 1)):
        far = rigid((0, np.deg2rad(times * turn_deg), 0), (times * shift_m, 0, 0))
        source = Reported(lambda i, far=far: far if i.seq == 5 else np.eye(4))
        camera = PosedCamera(ListCamera(images(6, step_ms)), source, PoseChecks(max_speed_m_s=1.0))
        run(camera)
        assert camera.counters["outliers"] == jumps


@pytest.mark.parametrize("far", [rigid(shift=(6.0, 0, 0)), rigid((0, 0, np.pi / 2))])
def test_a_source_that_begins_in_another_world_is_refused_until_it_comes_back(far: Float64) -> None:
    source = Reported(lambda i: (far if 8 <= i.seq < 600 else np.eye(4)) @ rigid(shift=(0.001 * i.seq, 0, 0)))
    camera = PosedCamera(ListCamera(images(610)), source)  # for a minute
    with camera:
        frames = iter(camera)
        seqs = [next(frames).seq for _ in range(9)]
        assert camera.counters["outliers"] == 592
        seqs += [frame.seq for frame in frames]
    assert seqs == [*range(8), *range(600, 610)]
    stays = moving(lambda seq: 0.0 if seq < 8 else 5.0, 600)
    assert run(stays) == [*range(8)]
    (trouble,) = stays.warnings[1:]
    assert "now 5.00 m and 0 degrees from the last one that was believed, 59.2 s ago" in trouble
    assert "start the launch again" in trouble


def test_a_source_that_says_that_its_world_is_another_one_is_believed() -> None:
    source = Reported(lambda i: rigid(shift=(6.0 if i.seq >= 8 else 0.0, 0, 0)), world_of=lambda i: 1 + (i.seq >= 8))
    with PosedCamera(ListCamera(images(16)), source) as camera:
        assert [f.world for f in camera] == [1] * 8 + [2] * 8
    short = Reported(lambda i: np.eye(4), world_of=lambda i: int(i.seq > 2))
    with PosedCamera(ListCamera(images(12)), short) as camera:
        assert [f.seq for f in camera] == list(range(3, 12)) and camera.counters["uninitialized"] == 3


def test_a_wrong_beginning_is_left_out() -> None:
    """Odometry that sends identity before it knows where it is, and then stands still far away."""
    for wrong in (1, 4):
        camera = moving(lambda seq, wrong=wrong: 0.0 if seq < wrong else 5.0, 40)
        assert run(camera) == [*range(wrong, 40)] and camera.counters["uninitialized"] == wrong
    jumping = moving(lambda seq: 5.0 * (seq % 2), 100)  # of two worlds that take turns none is believed
    assert run(jumping) == [] and jumping.counters["uninitialized"] == 100
    assert "last poses agree" in jumping.warnings[1]
    assert run(moving(lambda seq: 0.0, 3)) == [0, 1, 2], "a recording may be shorter than the wait"


def test_camera_and_poses_are_opened_stopped_and_freed_together() -> None:
    class Missing(ListCamera):
        def __enter__(self) -> Self:
            raise CameraError("gone")

    device, source = ListCamera(images(1)), Reported(lambda i: np.eye(4))
    with PosedCamera(device, source) as camera:
        assert device.is_open and source.is_open
        camera.stop()
        assert device.stopped
    assert not device.is_open and not source.is_open
    with pytest.raises(CameraError, match="gone"), PosedCamera(Missing([]), source):
        pass
    assert not source.is_open


def test_a_device_that_tracks_itself_may_take_as_long_for_its_first_pose_as_it_needs() -> None:
    quiet = [replace(unposed, tracks_itself=True) for unposed in images(40)]
    camera = PosedCamera(ListCamera([*quiet, image(5000 * MS, 40, own=np.eye(4))]), DevicePoseSource())
    assert run(camera) == [40] and camera.counters["no_pose"] == 40
    waits = PosedCamera(ListCamera(quiet), DevicePoseSource())
    assert run(waits) == [] and "does not know where it is" in waits.warnings[1]
    with pytest.raises(CameraError, match=r"no pose of its own.*kind = \"topic\".*kind = \"board\""):
        run(PosedCamera(ListCamera(images(2)), DevicePoseSource()))


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
