"""The protocols of sources: of frames, of camera images that have no pose yet, and of poses for them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame, UInt8


@runtime_checkable
class FrameSource(Protocol):
    """Something that gives posed frames; used as a context manager, which opens and frees the device or file.

    Iteration ends with the recording, never for a live camera. A frame that is lost or damaged is passed over, and
    shows as a gap in ``PosedFrame.seq``; a device that is gone raises the driver's error.
    """

    @property
    def info(self) -> StreamInfo:
        """Cameras with their intrinsics, the label set (None without labels), where the frames come from."""
        ...

    def __enter__(self) -> Self:
        """Open it."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free it."""
        ...

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order of capture."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Where a camera was.

    Args:
        T_world_camera: (4, 4) float64; of sources of a rig's poses (``poses_of_rig``), T_world_rig.
        source: What says so ("odometry", "board", "vio", ...); becomes ``PosedFrame.pose_source``.
        sigma: One-sigma position uncertainty in metres; 0 = not known.
        world: Which world the pose is in, where that begins with the source; becomes ``PosedFrame.world``.
    """

    T_world_camera: Float64
    source: str
    sigma: float = 0.0
    world: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedWorld:
    """What a pose source thinks now of where the camera was: the world of the poses to come.

    Args:
        poses: T_world_camera (4, 4) by stamp of the image, of as many of the past images as it remembers.
        until_ns: Stamp of the last image whose pose was of the world before.
        motion: (4, 4) what takes the last of these poses from the world before to this one.
    """

    poses: Mapping[int, Float64]
    until_ns: int
    motion: Float64


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """What a camera has captured, rectified: all of a ``PosedFrame`` but where the camera was.

    Args:
        stamp_ns, seq, camera_id, rgb, depth_m, intrinsics: As of ``PosedFrame``.
        own_pose: Of a device that tracks itself (visual-inertial odometry); None of all others, and while it is lost.
        tracks_itself: Whether the device does.
    """

    stamp_ns: int
    seq: int
    camera_id: str
    rgb: UInt8
    depth_m: Float32 | None
    intrinsics: CameraIntrinsics
    own_pose: PoseEstimate | None = None
    tracks_itself: bool = False


@runtime_checkable
class Camera(Protocol):
    """A device that gives images; otherwise as ``FrameSource``.

    A device that goes away and may come back is waited for within the driver: iteration goes on after a gap in
    ``seq``, and ``warnings`` says what is the matter meanwhile.
    """

    @property
    def info(self) -> StreamInfo:
        """As of ``FrameSource``; known once it is open."""
        ...

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        ...

    @property
    def can_wait(self) -> bool:
        """Whether its images wait until they are taken, as those of a file do; known before it is open."""
        ...

    @property
    def last_poll_time(self) -> float:
        """When the driver last came round (``time.monotonic``), with an image or without: while it waits for a device
        that is away or gives nothing, too, but not while a call into the device hangs. Any thread may ask."""
        ...

    def __enter__(self) -> Self:
        """Open it."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free it."""
        ...

    def __iter__(self) -> Iterator[CameraImage]:
        """Images in the order of capture."""
        ...

    def stop(self) -> None:
        """End the iteration soon, from any thread or signal handler."""
        ...


class PoseSource:
    """Base of what knows where a camera was; used as a context manager."""

    def __init__(self) -> None:
        self._warnings: tuple[str, ...] = ()
        self._counters: Counter[str] = Counter()

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        return self._warnings

    @property
    def counters(self) -> Counter[str]:
        """Totals since it was opened, by name; any thread may ask."""
        return Counter(self._counters)

    def __enter__(self) -> Self:
        """Open it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free it."""

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of an image, in the order of capture; None where it is not known (lost, too old): no frame then."""
        raise NotImplementedError

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """New poses of past images where a loop was closed, once after each change; to be called after each ``pose``.

        Args:
            final: No more images will come: finish what is under way.
        """
        return None
