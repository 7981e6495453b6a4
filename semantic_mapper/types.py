"""Plain data that travels through the system. Frozen, slotted, no behaviour beyond checks of form.

Frames: ``T_a_b`` maps points of frame b to frame a. Camera axes follow OpenCV (x right, y down, z forward).
Depth is z in metres, 0 = no measurement. Pixel centres have integer coordinates. Stamps are int64 nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError

if TYPE_CHECKING:
    import torch  # loads for seconds and takes half a gigabyte: a camera, a recorder and the launcher need none of it

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

MAX_SIDE = 1 << 14  # pixels
MAX_PIXELS = 1 << 25  # 8192 x 4096
# Focal lengths in image sides. 0.1 is a field of view of 157 degrees, about as far as the pinhole model of a rectified
# image goes (a raw 180 degree fisheye has 0.3); 100 is one of 0.6 degrees, a tele lens of 3.6 m on a 35 mm camera.
MIN_FOCAL, MAX_FOCAL = 0.1, 100.0
ROUNDING = 1e-6  # of these bounds: intrinsics on one must still be within once an image is resized
CENTER_MARGIN = 1.0  # image sides that the principal point may lie outside of the image, as it does in a crop
COEFFICIENTS = (0, 4, 5, 8, 12, 14)  # how many OpenCV's lens models have
MAX_DISTORTION = 1e6  # of a coefficient; ill-conditioned fits of the rational model reach thousands
MIN_DEPTH_M, MAX_DEPTH_M = 1e-3, 1e3  # what lies beyond, as NaN and infinity, is no measurement: float32 squares it
MAX_POSE_SIGMA_M = 1e6
MAX_STAMP_NS = 1 << 62  # 146 years, also as Unix time; sums and differences of two stay within int64


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """Pinhole model in pixels; ``distortion`` holds OpenCV coefficients, empty for a rectified image.

    This is the one place where intrinsics are checked, wherever they come from: the bounds are the constants above.
    Raises FrameError: a value is not finite or does not fit the image size; normalised intrinsics are named as such.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    @property
    def distorted(self) -> bool:
        """Whether an image of this camera has to be rectified."""
        return any(self.distortion)

    def __post_init__(self) -> None:
        got = f"got fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy} {self.width}x{self.height} {self.distortion}"
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.isfinite(values).all() or min(self.fx, self.fy, self.width, self.height) <= 0:
            raise FrameError(f"intrinsics must be finite, focal lengths and image size positive, {got}")
        if max(self.width, self.height) > MAX_SIDE or self.width * self.height > MAX_PIXELS:
            raise FrameError(
                f"an image of {self.width}x{self.height} is too large: at most {MAX_SIDE} pixels a side and "
                f"{MAX_PIXELS} in all; send smaller images"
            )
        _check_lens(self)
        if len(self.distortion) not in COEFFICIENTS or any(abs(d) > MAX_DISTORTION for d in self.distortion):
            raise FrameError(
                f"distortion has {len(self.distortion)} coefficients, {got}; give {COEFFICIENTS} of at most "
                f"{MAX_DISTORTION:g}: calibrate again"
            )


@dataclass(frozen=True, slots=True)
class FisheyeIntrinsics(CameraIntrinsics):
    """A lens of OpenCV's fisheye model (equidistant, Kannala-Brandt): ``distortion`` holds its k1 k2 k3 k4.

    A ``Rectifier`` makes a pinhole camera of it; frames have none. Raises FrameError: not four coefficients, and as
    ``CameraIntrinsics``.
    """

    @property
    def distorted(self) -> bool:
        """Always: a fisheye of no coefficients is no pinhole camera, either."""
        return True

    def __post_init__(self) -> None:
        CameraIntrinsics.__post_init__(self)  # super() without arguments fails in slotted dataclasses
        if len(self.distortion) != 4:
            raise FrameError(f"a fisheye lens has 4 coefficients (k1 k2 k3 k4), not {len(self.distortion)}")


def _check_lens(k: CameraIntrinsics) -> None:
    """Focal lengths and principal point against the image size, so that every ray has a bounded slope."""
    least, longest = MIN_FOCAL * (1 - ROUNDING), MAX_FOCAL * (1 + ROUNDING) * max(k.width, k.height)
    focal = least * k.width <= k.fx <= longest and least * k.height <= k.fy <= longest
    margin_x, margin_y = CENTER_MARGIN * (1 + ROUNDING) * k.width, CENTER_MARGIN * (1 + ROUNDING) * k.height
    if focal and -margin_x <= k.cx + 0.5 <= k.width + margin_x and -margin_y <= k.cy + 0.5 <= k.height + margin_y:
        return
    why = (
        f"the principal point must be in the image, or at most {CENTER_MARGIN:g} image side outside of it; where "
        "images were resized or cropped after calibration, scale and shift the intrinsics with them"
    )
    if k.fx < 5 and k.fy < 5 and 0 <= k.cx <= 1 and 0 <= k.cy <= 1:
        why = (
            "they look normalised to the image size, but must be in pixels; multiply fx and cx by the width and fy and "
            f"cy by the height (fx={k.fx * k.width:.6g} fy={k.fy * k.height:.6g} cx={k.cx * k.width:.6g} "
            f"cy={k.cy * k.height:.6g})"
        )
    elif not focal:
        why = (
            f"focal lengths must be in pixels, {MIN_FOCAL:g} (157 degrees of view) to {MAX_FOCAL:g} times the "
            "image side; check the calibration"
        )
    got = f"fx={k.fx:.6g} fy={k.fy:.6g} cx={k.cx:.6g} cy={k.cy:.6g}"
    raise FrameError(f"intrinsics {got} do not fit a {k.width}x{k.height} image: {why}")


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """One camera image with its pose, as a driver or a log gives it.

    Raises FrameError: a shape or dtype is off, or a number out of its range. ``geometry.check_pose`` checks the pose.
    """

    stamp_ns: int  # of capture, int64 nanoseconds on the robot's monotonic clock, 0 to ``MAX_STAMP_NS``
    seq: int  # counter of the source, from 0 to 2^63 - 1; missing numbers mean lost frames
    camera_id: str  # name of the camera
    rgb: UInt8  # (H, W, 3)
    # (H, W) z-depth in metres, None without a depth sensor; what is not from ``MIN_DEPTH_M`` to ``MAX_DEPTH_M``, such
    # as 0, is no measurement
    depth_m: Float32 | None
    label: UInt8 | None  # (H, W) class ids of the stream's label set; None = unlabelled
    intrinsics: CameraIntrinsics  # of the rectified image
    T_world_camera: Float64  # (4, 4)
    pose_source: str = "log"  # where the pose comes from ("log", "odometry", ...)
    pose_sigma: float = 0.0  # one-sigma position uncertainty in metres; 0 = not known
    # (H, W) one-sigma spread of ``depth_m`` in metres, where it was computed from pictures; None = measured
    depth_sigma_m: Float32 | None = None
    # ``label`` was rendered by a field (``autolabel``). It may be learned from, never scored against.
    label_is_pseudo: bool = False
    # of a camera whose world begins where it starts: which one the pose is in. 0 = the one that there is
    world: int = 0

    def __post_init__(self) -> None:
        k = self.intrinsics
        if isinstance(k, FisheyeIntrinsics):
            raise self._error("its fisheye lens has to be rectified")
        for name, most in (
            ("stamp_ns", MAX_STAMP_NS),
            ("seq", (1 << 63) - 1),
            ("world", (1 << 63) - 1),
            ("pose_sigma", MAX_POSE_SIGMA_M),
        ):
            if not 0 <= (value := getattr(self, name)) <= most:  # NaN, too
                raise self._error(f"{name} must be from 0 to {most}, got {value}")
        if self.depth_m is None and self.depth_sigma_m is not None:
            raise self._error("depth_sigma_m is the spread of depth_m, which is missing; give both or neither")
        size = (k.height, k.width)
        for name, shape, dtype in (
            ("rgb", (*size, 3), "uint8"),
            ("T_world_camera", (4, 4), "float64"),
            ("depth_m", size, "float32"),
            ("depth_sigma_m", size, "float32"),
            ("label", size, "uint8"),
        ):
            array = getattr(self, name)
            if array is not None and (array.shape != shape or array.dtype != dtype):
                raise self._error(
                    f"{name} must be {dtype} {shape} (the intrinsics say {k.width}x{k.height}), "
                    f"got {array.dtype.name} {array.shape}"
                )

    def _error(self, what: str) -> FrameError:
        return FrameError(f"frame seq={self.seq} of camera '{self.camera_id}': {what}")


@dataclass(frozen=True, slots=True, eq=False)
class SourceViews:
    """The m images that a semantic field looks at, in one resolution."""

    rgb: torch.Tensor  # (m, 3, H, W) float32 in [0, 1]
    depth_m: torch.Tensor  # (m, H, W) float32, 0 = no measurement; all 0 for a view without depth
    K: torch.Tensor  # (m, 3, 3) float32 pinhole matrices in pixels of (H, W)
    T_world_camera: torch.Tensor  # (m, 4, 4) float32
    # (m, H, W) int64 class channels that are known of the views, -1 = none; None for views without labels
    channel: torch.Tensor | None = None
    # (m, H, W) float32 one-sigma spread of ``depth_m`` where it was computed from pictures, 0 where it was measured;
    # None where all of it was
    depth_sigma_m: torch.Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RayBatch:
    """R query rays in world coordinates."""

    origin: torch.Tensor  # (R, 3) float32 metres
    direction: torch.Tensor  # (R, 3) float32: ``origin + z * direction`` has camera depth z (not of unit length)
    near_m: torch.Tensor  # (R,) float32 z bounds of the search
    far_m: torch.Tensor
    prior_depth_m: torch.Tensor  # (R,) float32 z from a sensor or a map, 0 = none
    # (R,) bool, where the prior is measured at the very pixel rather than filled in; None = wherever one is
    measured: torch.Tensor | None = None
    stamp_ns: int | None = None  # when they are, for fields with things that move; None = such things are not there


@dataclass(frozen=True, slots=True, eq=False)
class FieldRender:
    """What a semantic field renders for R rays."""

    logits: torch.Tensor  # (R, L) rendered class logits (S-Ray Eq. 13); zeros where ``known`` is False
    depth_m: torch.Tensor  # (R,) expected z depth
    opacity: torch.Tensor  # (R,) in [0, 1]
    rgb: torch.Tensor  # (R, 3) in [0, 1]
    entropy: torch.Tensor  # (R,) of the class distribution, nats; ln L where nothing is known
    known: torch.Tensor  # (R,) bool, False where no source view sees the ray: an explicit "unknown", not a guess


@dataclass(frozen=True, slots=True, eq=False)
class MapUpdate:
    """What one ``MappingPipeline.step`` did."""

    stamp_ns: int  # of the frame, as ``seq`` and ``camera_id``
    seq: int
    camera_id: str
    fused: bool  # False where the frame was looked at but not fused
    is_keyframe: bool  # whether the frame became a source view for later ones
    source_seqs: tuple[int, ...]  # sequence numbers of the source views that were rendered from
    label: UInt8  # (H, W) class ids: rendered, or the map's where the frame has no depth; the ignore id where unknown
    confidence: Float32  # (H, W) probability of ``label``
    depth_m: Float32  # (H, W) depth that was fused; in ``moving`` pixels that which was left out
    blocks: int  # in the map
    blocks_touched: int  # visited by this frame
    rays: int = 0  # rendered for this frame
    samples: int = 0  # of a ray, 0 where the field draws its own
    stage_ms: dict[str, float] = field(default_factory=dict[str, float])  # wall time of each stage
    # (H, W), what was left out of the map because it moves; None where that is off, or over sockets nothing moves
    moving: Bool | None = None
    world: int = 0  # in which the frame's pose came; see ``PosedFrame``
    # (4, 4), where the map has that world: its cameras are at ``T_map_world @ T_world_camera``
    T_map_world: Float64 = field(default_factory=lambda: np.eye(4))
