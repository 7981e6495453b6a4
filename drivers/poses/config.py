"""Settings of the pose sources. Every default is documented where it is declared."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from semantic_mapper.config import AtLeastOne, Config, Positive
from semantic_mapper.drivers.calibration import Matrix, load_mount, rigid_matrix
from semantic_mapper.errors import ConfigError
from semantic_mapper.types import Float64

OTHER_FILES = ("oak", "stereo")  # kinds of cameras whose `calibration` is a file of another form
IDENTITY: Matrix = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
Text = Annotated[str, msgspec.Meta(min_length=1)]
WAYS_OUT = (
    'give it a pose from outside (kind = "topic": the robot\'s own odometry), a printed board that it sees (kind = '
    '"board"), a place where it stands still (kind = "fixed"), its own pictures (kind = '
    '"visual"), or use a camera with depth (kind = "rgbd") or one that tracks itself (kind = "device")'
)


class DevicePoses(Config, frozen=True):
    """The camera tracks itself (visual-inertial odometry on the device)."""

    kind: Literal["device"] = "device"


class FixedPose(Config, frozen=True):
    """The camera never moves."""

    kind: Literal["fixed"] = "fixed"
    T_world_camera: Matrix = IDENTITY
    T_world_rig: Matrix | None = None  # in its place, of a camera on a rig: where it sits there is its T_rig_camera

    def __post_init__(self) -> None:
        if self.T_world_rig is not None and self.T_world_camera != IDENTITY:
            raise ValueError("give T_world_camera or, of a camera on a rig, T_world_rig")


class TopicPoses(Config, frozen=True):
    """A robot's own odometry, published on a ZeroMQ PUB socket in the form of ``transport/pose_message.py``."""

    endpoint: Text  # of the publisher; this side connects. On another machine it must have keys (CURVE), see `server`
    kind: Literal["topic"] = "topic"
    server: str = ""  # name of the publisher's machine among the peers of `semantic-mapper keys`; empty = in the clear
    keys: Text = "~/.config/semantic-mapper/keys"  # with `server`: folder of this machine's keys
    topic: str = ""  # messages whose first part begins so; empty = all
    T_base_camera: Matrix = IDENTITY  # where the camera sits on what the messages are about
    T_base_rig: Matrix | None = None  # in its place: where a rig sits; its cameras have each a T_rig_camera
    clock_offset_ns: int = 0  # added to the stamps of messages, where the robot's clock differs by a known time

    def __post_init__(self) -> None:
        if self.T_base_rig is not None and self.T_base_camera != IDENTITY:
            raise ValueError("give T_base_camera or, of a camera on a rig, T_base_rig")


class BoardPoses(Config, frozen=True):
    """A printed board that stands still: ChArUco, or AprilTags in a grid (1 x 1: a single tag)."""

    kind: Literal["board"] = "board"
    pattern: Literal["charuco", "tags"] = "charuco"
    dictionary: str = ""  # OpenCV's name; empty = DICT_5X5_100 for ChArUco, DICT_APRILTAG_36h11 for tags
    columns: AtLeastOne = 7  # squares of a ChArUco board, else tags
    rows: AtLeastOne = 5
    square_m: Positive = 0.04  # ChArUco: side of a square; tags: from the edge of one to the same edge of the next
    marker_m: Positive = 0.03  # side of a marker, its black border included
    T_world_board: Matrix = IDENTITY  # board: x along its rows, y down its columns, z away from the viewer, into it

    def __post_init__(self) -> None:
        if self.marker_m >= self.square_m and self.columns * self.rows > 1:
            raise ValueError(f"marker_m ({self.marker_m:g}) must be smaller than square_m ({self.square_m:g})")
        if self.pattern == "charuco" and min(self.columns, self.rows) < 2:
            raise ValueError("a ChArUco board has at least 2 columns and 2 rows")


class OdometryPoses(Config, frozen=True):
    """RGB-D odometry: each frame is aligned to several keyframes; the world begins at the first frame."""

    kind: Literal["rgbd"] = "rgbd"
    T_world_start: Matrix = IDENTITY  # T_world_camera of the first frame
    loop_closure: bool = True  # where the camera comes back to a place, correct the way in between, and the map with it


class VisualPoses(Config, frozen=True):
    """Visual odometry of a single camera; the world begins where it or its ``scale`` does."""

    kind: Literal["visual"] = "visual"
    # Where the scale comes from: a table of "topic" (the robot's odometry, however coarse) or "board" (a printed one,
    # seen at the beginning). The world is the one of these poses then.
    scale: dict[str, Any] = msgspec.field(default_factory=dict)
    # In its place, for a camera that is carried at one height over a flat floor that it sees: how high. Every keyframe
    # that sees the floor corrects the scale. Without T_world_start the camera is taken to be level.
    camera_height_m: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    T_world_start: Matrix = IDENTITY  # T_world_camera of the first picture, where there is no ``scale``

    def __post_init__(self) -> None:
        if self.scale and self.scale.get("kind") not in ("topic", "board"):
            raise ValueError('scale: kind must be "topic" or "board"')
        if self.scale and self.camera_height_m:
            raise ValueError("give one of scale and camera_height_m")


PoseConfig = DevicePoses | FixedPose | TopicPoses | BoardPoses | OdometryPoses | VisualPoses
KINDS: dict[str, type[PoseConfig]] = {
    "device": DevicePoses,
    "fixed": FixedPose,
    "topic": TopicPoses,
    "board": BoardPoses,
    "rgbd": OdometryPoses,
    "visual": VisualPoses,
}


class PoseChecks(Config, frozen=True):
    """Which poses ``PosedCamera`` refuses."""

    max_speed_m_s: Positive = 3.0  # faster than this between two images is a jump


def gives_metres(config: PoseConfig) -> bool:
    """Whether poses are in metres; those of pictures alone have a unit of their own."""
    return not isinstance(config, VisualPoses) or bool(config.scale or config.camera_height_m)


def begins_world(config: PoseConfig) -> bool:
    """Whether the world of the poses begins with the process: that of another process is another one."""
    return isinstance(config, DevicePoses | OdometryPoses | VisualPoses)


def can_be_found(config: PoseConfig) -> bool:
    """Whether a camera whose world begins again is found in the map: with depth, and where no setting says that its
    world is the one of other cameras."""
    return isinstance(config, DevicePoses) or (isinstance(config, OdometryPoses) and config.T_world_start == IDENTITY)


def poses_of_rig(config: PoseConfig) -> bool:
    """Whether poses are of a rig, on which the camera sits somewhere, rather than of the camera itself."""
    return (getattr(config, "T_world_rig", None) or getattr(config, "T_base_rig", None)) is not None


def mount_for(
    poses: PoseConfig, rows: Matrix | None, kind: str, config: Mapping[str, Any], camera: str
) -> Float64 | None:
    """T_rig_camera (4, 4) where poses are those of a rig; None where they are the camera's own.

    It is that of the camera's settings (``rows``), else of the calibration file that ``config``, its driver's settings,
    may name. Raises ConfigError: it is needed and not known, requested and without effect, or no rigid transform.
    """
    if not poses_of_rig(poses):
        if rows is None:
            return None
        raise ConfigError(
            f'{camera}: has a T_rig_camera, but its poses (kind "{poses.kind}") are the camera\'s own; of a '
            'rig they are with T_base_rig (kind "topic") or T_world_rig (kind "fixed")'
        )
    if rows is not None:
        return rigid_matrix(rows, f"{camera}: T_rig_camera")
    file = config.get("calibration", "")
    mount = load_mount(Path(file)) if file and kind not in OTHER_FILES else None
    if mount is None:
        raise ConfigError(
            f"{camera}: its poses are those of a rig, and nothing says where it sits there; give "
            "T_rig_camera, or a calibration file that has one (`semantic-mapper calibrate` with all cameras)"
        )
    return mount
