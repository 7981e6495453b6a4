"""Poses that need no work: of a camera that tells its own, and of one that never moves."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from semantic_mapper.drivers.base import CameraImage, PoseEstimate
from semantic_mapper.drivers.poses.config import DevicePoses, FixedPose, matrix
from semantic_mapper.errors import CameraError

WAYS_OUT = (
    'give it a pose from outside (kind = "topic": the robot\'s own odometry), a printed board that it sees (kind = '
    '"board"), a place where it stands still (kind = "fixed"), its own pictures (kind = '
    '"visual"), or use a camera with depth (kind = "rgbd") or one that tracks itself (kind = "device")'
)


class DevicePoseSource:
    """Takes the poses that the device itself puts into its images.

    Args:
        config: How long it may take for its first one.
    """

    def __init__(self, config: DevicePoses) -> None:
        self._patience_ns = round(config.patience_s * 1e9)
        self._first_ns: int | None = None  # of the images; None once there was a pose
        self._tracked = False
        self._warnings: tuple[str, ...] = ()
        self.counters: dict[str, int] = {}

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence while the device does not know where it is."""
        return self._warnings

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The image's own pose; None where the device does not know it now, or not yet.

        Raises:
            CameraError: no image had one for ``patience_s``, and the camera does not track itself.
        """
        self._tracked |= image.tracks_itself
        if image.own_pose is not None:
            self._tracked, self._warnings = True, ()
            return image.own_pose
        self._first_ns = image.stamp_ns if self._first_ns is None else self._first_ns
        waited_ns = image.stamp_ns - self._first_ns
        if not self._tracked and waited_ns > self._patience_ns:
            raise CameraError(
                f"camera '{image.camera_id}' has told no pose of its own for {waited_ns / 1e9:.1f} s, so it does not "
                f"track itself, or its tracking is not switched on; {WAYS_OUT}"
            )
        self._warnings = (f"camera '{image.camera_id}' does not know where it is; frames are left out until it does",)
        return None


class FixedPoseSource:
    """The same pose for every image.

    Args:
        config: Which.
    """

    def __init__(self, config: FixedPose) -> None:
        self._estimate = PoseEstimate(matrix(config.T_world_rig or config.T_world_camera), "fixed", config.sigma)
        self.counters: dict[str, int] = {}

    @property
    def warnings(self) -> tuple[str, ...]:
        """None, ever."""
        return ()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The pose."""
        return self._estimate
