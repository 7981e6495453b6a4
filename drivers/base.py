"""What cameras give (images that have no pose yet), what pose sources give, and the bases of both."""

import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

from semantic_mapper.errors import CameraError
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """Where a camera was."""

    T_world_camera: Float64  # (4, 4) float64; of sources of a rig's poses (``poses_of_rig``), T_world_rig
    source: str  # what says so ("odometry", "board", "vio", ...); becomes ``PosedFrame.pose_source``
    sigma: float = 0.0  # One-sigma position uncertainty in metres; 0 = not known
    world: int = 0  # which world the pose is in, where that begins with the source; becomes ``PosedFrame.world``


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedWorld:
    """What a pose source thinks now of where the camera was: the world of the poses to come."""

    # T_world_camera (4, 4) by stamp of the image, of as many of the past images as it remembers
    poses: Mapping[int, Float64]
    until_ns: int  # stamp of the last image whose pose was of the world before
    motion: Float64  # (4, 4) what takes the last of these poses from the world before to this one


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """What a camera has captured, rectified: all of a ``PosedFrame`` but where the camera was."""

    stamp_ns: int  # this and those that follow as of ``PosedFrame``
    seq: int
    camera_id: str
    rgb: UInt8
    depth_m: Float32 | None
    intrinsics: CameraIntrinsics
    # of a device that tracks itself (visual-inertial odometry); None of all others, and while it is lost
    own_pose: PoseEstimate | None = None
    tracks_itself: bool = False  # whether the device does


@contextmanager
def as_camera_error(what: str, fix: str, *kinds: type[Exception]) -> Iterator[None]:
    """Errors of these kinds within, such as those of a vendor's SDK, become ``CameraError``."""
    try:
        yield
    except kinds as error:
        raise CameraError(f"{what}: {error}; {fix}") from error


class Camera:
    """Base of devices that give images; used as a context manager, which opens and frees the device or file.

    Iteration ends with a recording, never for a live camera. An image that is lost or damaged is passed over, and shows
    as a gap in ``seq``. A device that goes away and may come back is waited for within the driver; ``warnings`` says so
    meanwhile. What no waiting can fix raises ``CameraError``.
    """

    can_wait = False  # whether its images wait until they are taken, as those of a file do; known before it is open

    def __init__(self, camera_id: str) -> None:
        self._camera_id = camera_id
        self._info: StreamInfo | None = None  # known once it is open
        self._stopping = threading.Event()
        self._last_poll_time = 0.0

    @property
    def info(self) -> StreamInfo:
        """Its intrinsics, its device, its rate; raises ``CameraError`` where it is not open."""
        if self._info is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        return self._info

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        return ()

    @property
    def last_poll_time(self) -> float:
        """When the driver last came round (``time.monotonic``), with an image or without: while it waits for a device
        that is away or gives nothing, too, but not while a call into the device hangs. Any thread may ask."""
        return self._last_poll_time

    def __enter__(self) -> Self:
        """Open it; raises ``CameraError`` where it is not there, or cannot do what its config asks for."""
        raise NotImplementedError

    def __exit__(self, *error: object) -> None:
        """Free it."""
        self.stop()

    def __iter__(self) -> Iterator[CameraImage]:
        """Images in the order of capture; raises ``CameraError`` where it is not open, or has failed for good."""
        raise NotImplementedError

    def stop(self) -> None:
        """End the iteration soon, from any thread or signal handler."""
        self._stopping.set()  # no lock: a signal handler may interrupt the thread that holds it


class PoseSource:
    """Base of what knows where a camera was; used as a context manager."""

    def __init__(self) -> None:
        self._warnings: tuple[str, ...] = ()
        self._counters: Counter[str] = Counter()
        self._camera: tuple[str, CameraIntrinsics] | None = None  # the only one that is followed, where there is one

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        return self._warnings

    @property
    def counters(self) -> Counter[str]:
        """Totals since it was opened, by name; any thread may ask."""
        return Counter(self._counters)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Free it."""

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of an image, in the order of capture; None where it is not known (lost, too old): no frame then."""
        raise NotImplementedError

    def _expect_one_camera(self, image: CameraImage) -> None:
        """Raise ``CameraError`` where an image is of another camera or size than the first one."""
        camera = (image.camera_id, image.intrinsics)
        self._camera = self._camera or camera
        if camera != self._camera:
            raise CameraError(
                f"odometry follows camera '{self._camera[0]}' at {self._camera[1].width}x{self._camera[1].height}; an "
                f"image of '{image.camera_id}' at {image.intrinsics.width}x{image.intrinsics.height} came: give each "
                "camera a pose source of its own, and do not change its resolution"
            )

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """New poses of past images where a loop was closed, once after each change; to be called after each ``pose``.
        ``final``: no more images will come: finish what is under way."""
        return None
