"""Settings of the pose sources. Every default is documented where it is declared."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from semantic_mapper.config import AtLeastOne, AtLeastZero, Config, Fraction, NotNegative, PoseRefinerConfig, Positive
from semantic_mapper.drivers.calibration import Matrix
from semantic_mapper.types import Float64

IDENTITY: Matrix = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
Text = Annotated[str, msgspec.Meta(min_length=1)]


def matrix(rows: Matrix) -> Float64:
    """Rows -> (4, 4)."""
    return np.array(rows, np.float64)


class DevicePoses(Config, frozen=True):
    """The camera tracks itself (visual-inertial odometry on the device)."""

    kind: Literal["device"] = "device"
    patience_s: Positive = 20.0  # how long a device that does not say that it tracks itself may take for a pose


class FixedPose(Config, frozen=True):
    """The camera never moves."""

    kind: Literal["fixed"] = "fixed"
    T_world_camera: Matrix = IDENTITY
    T_world_rig: Matrix | None = None  # in its place, of a camera on a rig: where it sits there is its T_rig_camera
    sigma: AtLeastZero = 0.0  # metres; 0 = not known

    def __post_init__(self) -> None:
        if self.T_world_rig is not None and self.T_world_camera != IDENTITY:
            raise ValueError("give T_world_camera or, of a camera on a rig, T_world_rig")


class TopicPoses(Config, frozen=True):
    """A robot's own odometry, told on a ZeroMQ PUB socket as ``transport/pose_message.py`` says."""

    endpoint: Text  # of the publisher; this side connects. On another machine it must have keys (CURVE), see `server`
    kind: Literal["topic"] = "topic"
    server: str = ""  # name of the publisher's machine among the peers of `semantic-mapper keys`; empty = in the clear
    keys: Text = "~/.config/semantic-mapper/keys"  # with `server`: folder of this machine's keys
    topic: str = ""  # messages whose first part begins so; empty = all
    parent: str = ""  # frame that messages must name as theirs; empty = any
    child: str = ""
    T_base_camera: Matrix = IDENTITY  # where the camera sits on what the messages tell of
    cameras: dict[str, Matrix] = msgspec.field(default_factory=dict)  # the same for single cameras, by id
    T_base_rig: Matrix | None = None  # in place of both: where a rig sits; its cameras have each a T_rig_camera
    clock_offset_ns: int = 0  # added to the stamps of messages, where the robot's clock differs by a known time
    max_clock_difference_s: Positive = 1.0  # fresh messages whose stamps are further from the images' are refused
    wait_s: AtLeastZero = 0.05  # how long an image waits for a pose at or after it, before the motion is extrapolated
    max_ahead_s: AtLeastZero = 0.05  # beyond the last pose; an image that is further ahead has none
    max_gap_s: Positive = 0.3  # between two poses further apart nothing is interpolated
    keep: AtLeastOne = 2000  # poses kept

    def __post_init__(self) -> None:
        if self.T_base_rig is not None and (self.cameras or self.T_base_camera != IDENTITY):
            raise ValueError("give T_base_rig, or else T_base_camera and cameras")


class BoardPoses(Config, frozen=True):
    """A printed board that stands still: ChArUco, or AprilTags in a grid (1 x 1: a single tag)."""

    kind: Literal["board"] = "board"
    pattern: Literal["charuco", "tags"] = "charuco"
    dictionary: str = ""  # OpenCV's name; empty = DICT_5X5_100 for ChArUco, DICT_APRILTAG_36h11 for tags
    columns: AtLeastOne = 7  # squares of a ChArUco board, else tags
    rows: AtLeastOne = 5
    square_m: Positive = 0.04  # ChArUco: side of a square; tags: from the edge of one to the same edge of the next
    marker_m: Positive = 0.03  # side of a marker, its black border included
    legacy: bool = False  # ChArUco boards drawn by OpenCV before 4.6, with even rows
    T_world_board: Matrix = IDENTITY  # board: x along its rows, y down its columns, z away from the viewer, into it
    min_corners: Annotated[int, msgspec.Meta(ge=4)] = 6  # seen, for a pose; one tag has 4
    max_error_px: Positive = 1.5  # RMS reprojection error of a pose that is used
    max_sigma_m: Positive = 0.05  # of the camera's position
    min_flip_ratio: Annotated[float, msgspec.Meta(ge=1)] = 1.5  # a flat board's mirrored pose must fit so much worse

    def __post_init__(self) -> None:
        if self.marker_m >= self.square_m and self.columns * self.rows > 1:
            raise ValueError(f"marker_m ({self.marker_m:g}) must be smaller than square_m ({self.square_m:g})")
        if self.pattern == "charuco" and min(self.columns, self.rows) < 2:
            raise ValueError("a ChArUco board has at least 2 columns and 2 rows")
        if self.pattern == "tags" and self.min_corners > 4 * self.columns * self.rows:
            raise ValueError(f"min_corners = {self.min_corners}: the board has {4 * self.columns * self.rows}")


class OdometryPoses(Config, frozen=True):
    """RGB-D odometry: each frame is aligned to several keyframes; the world begins at the first frame."""

    kind: Literal["rgbd"] = "rgbd"
    T_world_start: Matrix = IDENTITY  # T_world_camera of the first frame
    width: AtLeastOne = 320  # images are thinned out to about this
    depth_max_m: Positive = 4.0
    iterations: tuple[AtLeastOne, ...] = (20, 15, 10)  # at most, from the coarsest level, each half as wide as the next
    outlier_m: Positive = 0.07  # points further than this from the surface do not count
    noise_m: Positive = 0.009  # of depth at 1 m, growing with its square; beyond this a distance counts less
    neighbours: AtLeastOne = 3  # keyframes that a frame is aligned to
    keyframe_m: Positive = 0.35  # a new one when moved this far from the nearest, or ...
    keyframe_deg: Positive = 20.0  # ... turned this far, or ...
    keyframe_overlap: Fraction = 0.55  # ... seeing less than this in common with it
    max_keyframes: AtLeastOne = 500  # 0.5 MB each; the oldest of the most crowded place goes first
    min_fitness: Fraction = 0.5  # of the frame's points that the keyframe sees must lie on its surface
    min_overlap: Fraction = 0.35  # of the frame's points that have to be in a keyframe's view
    max_rmse_m: Positive = 0.025  # of the distances that count
    max_step_m: Positive = 0.25  # a result further from its first guess is none
    max_step_deg: Positive = 15.0
    features: AtLeastOne = 500  # ORB corners an image, for first guesses and for finding back
    min_matches: Annotated[int, msgspec.Meta(ge=6)] = 15  # consistent ones, for a guess
    relocalise_keyframes: AtLeastOne = 20  # tried for each image while lost, in turn
    drift: Fraction = 0.05  # of the way: what ``sigma`` grows by with the chain of keyframes
    loop_closure: bool = True  # where the camera comes back to a place, correct the way in between, and the map with it


class VisualPoses(Config, frozen=True):
    """Visual odometry of a single camera; the world begins where it or its ``scale`` does."""

    kind: Literal["visual"] = "visual"
    # Where the scale comes from: a table of "topic" (the robot's odometry, however coarse) or "board" (a printed one,
    # seen at the beginning). The world is the one of these poses then.
    scale: dict[str, Any] = msgspec.field(default_factory=dict)
    # In its place: from the camera to what is in the middle of the picture that the world begins with.
    distance_m: AtLeastZero = 0.0
    # In its place, for a camera that is carried at one height over a flat floor that it sees: how high. Every keyframe
    # that sees the floor corrects the scale. Without T_world_start the camera is taken to be level.
    camera_height_m: AtLeastZero = 0.0
    T_world_start: Matrix = IDENTITY  # T_world_camera of the first picture, where there is no ``scale``
    tracking: PoseRefinerConfig = PoseRefinerConfig(window=10)
    drift: Fraction = 0.03  # of the way: what ``sigma`` grows by

    def __post_init__(self) -> None:
        if self.scale and self.scale.get("kind") not in ("topic", "board"):
            raise ValueError('scale: kind must be "topic" or "board"')
        if bool(self.scale) + bool(self.distance_m) + bool(self.camera_height_m) > 1:
            raise ValueError("give one of scale, distance_m and camera_height_m")


PoseConfig = DevicePoses | FixedPose | TopicPoses | BoardPoses | OdometryPoses | VisualPoses


def gives_metres(config: PoseConfig) -> bool:
    """Whether poses are in metres; those of pictures alone have a unit of their own."""
    return not isinstance(config, VisualPoses) or bool(config.scale or config.distance_m or config.camera_height_m)


def begins_world(config: PoseConfig) -> bool:
    """Whether the world of the poses begins with the process: that of another process is another one."""
    return isinstance(config, DevicePoses | OdometryPoses | VisualPoses)


def can_be_found(config: PoseConfig) -> bool:
    """Whether a camera whose world begins anew is found again in the map: with depth, and where no setting says that
    its world is the one of other cameras."""
    return isinstance(config, DevicePoses) or (isinstance(config, OdometryPoses) and config.T_world_start == IDENTITY)


def tells_of_rig(config: PoseConfig) -> bool:
    """Whether poses are of a rig, on which the camera sits somewhere, rather than of the camera itself."""
    match config:
        case FixedPose():
            return config.T_world_rig is not None
        case TopicPoses():
            return config.T_base_rig is not None
        case _:
            return False


KINDS: dict[str, type[PoseConfig]] = {
    "device": DevicePoses,
    "fixed": FixedPose,
    "topic": TopicPoses,
    "board": BoardPoses,
    "rgbd": OdometryPoses,
    "visual": VisualPoses,
}


class PoseChecks(Config, frozen=True):
    """What ``PosedCamera`` refuses."""

    max_speed_m_s: Positive = 3.0  # faster than this between two images is a jump
    max_turn_deg_s: Positive = 360.0
    slack_m: AtLeastZero = 0.05  # a pose may be off by so much at any rate
    slack_deg: AtLeastZero = 3.0
    # A camera's first frames are held back until this many of their poses agree with each other (and are given then):
    # one
    # wrong pose, such as a robot's before it knows where it is, is no place to go on from. 1 = the first is believed.
    init_consensus: AtLeastOne = 5
    # After a jump, this many poses in a row that agree with each other are taken for true. 0 = none: a source that
    # begins
    # in another world would spoil the map. One that jumps back, or that was only a little too quick, passes again.
    relocalize_after: NotNegative = 0
