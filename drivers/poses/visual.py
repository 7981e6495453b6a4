"""Visual odometry as a pose source: a single camera without depth, its scale from whatever gives one."""

from __future__ import annotations

from collections import Counter
from types import TracebackType
from typing import Self

import numpy as np

from semantic_mapper.bundle.odometry import VisualOdometry
from semantic_mapper.bundle.picture_checks import PictureChecker
from semantic_mapper.bundle.scale import ScaleEstimator
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import VisualPoses, gives_metres, matrix
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import CameraIntrinsics, Float64

_LEVEL = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))  # looking along x, z up
_TRACKING = PoseRefinerConfig(window=10)
_DRIFT = 0.03  # of the way: what ``sigma`` grows by
_GAIN = 0.3  # of the way to a new scale that a keyframe goes
_UNKNOWN = (
    "scale: unknown: poses are up to scale, and nothing in the map is in metres; give the robot's odometry "
    '(scale = { kind = "topic", endpoint = ... }), a board (scale = { kind = "board", ... }), distance_m or '
    "camera_height_m"
)

_log = get_logger(__name__)


class VisualPoseSource(PoseSource):
    """Follows one camera by its pictures. Not for several threads at once, but any may read ``counters``, ``warnings``.

    Args:
        config: How.
        reference: Coarse poses of the same camera in metres that the scale comes from; None without.

    Attributes:
        counters: As of ``VisualOdometry``; "without_scale": images that had no pose because the scale was not known
            yet; what ``PictureChecker`` counts; with "scale_" before them, those of the reference.
    """

    def __init__(self, config: VisualPoses, reference: PoseSource | None = None) -> None:
        super().__init__()
        self._config = config
        self._reference = reference
        self._camera: tuple[str, CameraIntrinsics] | None = None
        self._odometry: VisualOdometry | None = None
        self._checks = PictureChecker()
        self._estimator = ScaleEstimator()
        self._metric = False
        self._world_begun = False
        self._way = 0.0
        self._last: Float64 | None = None
        self._without_scale = 0
        self._trouble = ""

    @property
    def scale(self) -> str:
        """Whether poses are in metres: "known", "unknown", or "awaited" from the reference."""
        if self._metric:
            return "known"
        return "awaited" if self._reference is not None or gives_metres(self._config) else "unknown"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the last image had no pose, what is wrong with the pictures, and that the scale is not known."""
        reference = () if self._reference is None else self._reference.warnings
        unknown = (_UNKNOWN,) if self.scale == "unknown" else ()
        return (*((self._trouble,) if self._trouble else ()), *unknown, *self._checks.warnings, *reference)

    @property
    def counters(self) -> Counter[str]:
        """Totals; see the class."""
        counted = {} if self._odometry is None else dict(self._odometry.counters)
        scale = {} if self._reference is None else {f"scale_{n}": c for n, c in self._reference.counters.items()}
        return Counter({**counted, "without_scale": self._without_scale, **dict(self._checks.counters), **scale})

    def __enter__(self) -> Self:
        if self._reference is not None:
            self._reference.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._reference is not None:
            self._reference.__exit__(kind, error, trace)

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of the next image; None before the world begins, before the scale is known, and while lost.

        Raises:
            CameraError: images of another camera or size come in between.
        """
        odometry = self._follow(image)
        reference = None if self._reference is None else self._reference.pose(image)
        self._checks.look(image.rgb)
        was_lost = odometry.lost
        pose = odometry.push(image.rgb, image.stamp_ns)
        if pose is None:
            self._estimator.interrupt()
            self._last = None
            self._trouble = self._why(odometry)
            if odometry.lost and not was_lost:
                _log.warning("visual_odometry_lost", stamp_ns=image.stamp_ns, reason=self._checks.reason)
            return None
        pose = self._scaled(odometry, pose, None if reference is None else reference.T_world_camera)
        if self.scale == "awaited":
            self._without_scale += 1
            floor = ", and let it see the floor" if self._config.camera_height_m else ""
            self._trouble = f"the scale is not known yet: move the camera on{floor}"
            return None
        self._trouble = ""
        if self._last is not None:
            self._way += float(np.linalg.norm(pose[:3, 3] - self._last[:3, 3]))
        self._last = pose
        return PoseEstimate(pose, "visual", _DRIFT * self._way)

    def _follow(self, image: CameraImage) -> VisualOdometry:
        camera = (image.camera_id, image.intrinsics)
        if self._odometry is None:
            self._camera = camera
            self._odometry = VisualOdometry(image.intrinsics, _TRACKING)
        if camera != self._camera:
            raise CameraError(
                f"visual odometry follows one camera at one size; an image of '{image.camera_id}' at "
                f"{image.intrinsics.width}x{image.intrinsics.height} came in between: give each camera a pose source "
                "of its own, and do not change its resolution"
            )
        return self._odometry

    def _why(self, odometry: VisualOdometry) -> str:
        if odometry.lost:
            also = f" ({self._checks.reason})" if self._checks.reason else ""
            return f"the visual odometry is lost{also}; show the camera a place that it has seen before"
        return "the visual odometry has not begun: move the camera sideways, before something with texture"

    def _scaled(self, odometry: VisualOdometry, pose: Float64, reference: Float64 | None) -> Float64:
        """The pose once what is known of the scale, and of where the world begins, is brought into the map."""
        if self._config.camera_height_m:
            return self._over_floor(odometry, pose)
        if not self._metric and self._reference is None:
            depth = odometry.center_depth() if self._config.distance_m else None
            self._metric = depth is not None
            if self._world_begun or (depth is None and self._config.distance_m):
                return pose
            factor = self._config.distance_m / depth if depth else 1.0
            return self._begin_world(odometry, pose, factor, matrix(self._config.T_world_start))
        if reference is None:
            return pose
        self._estimator.add(reference[:3, 3], pose[:3, 3])
        scale = self._estimator.scale() if odometry.keyframe_added else None
        if scale is None:
            return pose
        if not self._metric:
            self._metric = True
            after = reference
            odometry.rescale(scale, pose, after, everything=True)
            self._estimator.rescaled(scale, pose, after)
            return after
        factor = float(scale**_GAIN)
        odometry.rescale(factor, pose, pose, everything=False)
        self._estimator.rescaled(factor, pose, pose)
        return pose

    def _over_floor(self, odometry: VisualOdometry, pose: Float64) -> Float64:
        """The pose once the distance from the floor is brought to what the camera's height over it is."""
        if not odometry.keyframe_added:
            return pose
        start = matrix(self._config.T_world_start)
        if np.array_equal(start, np.eye(4)):
            start[:3, :3], start[2, 3] = _LEVEL, self._config.camera_height_m
        found = odometry.floor_below(np.array((0.0, 0.0, 1.0)) if self._world_begun else start[2, :3])
        if found is None:
            return pose
        factor = self._config.camera_height_m / found
        self._metric = True
        if not self._world_begun:
            return self._begin_world(odometry, pose, factor, start)
        odometry.rescale(factor**_GAIN, pose, pose, everything=False)
        return pose

    def _begin_world(self, odometry: VisualOdometry, pose: Float64, factor: float, start: Float64) -> Float64:
        """The map's first view, at the identity until now, is put to where the world begins."""
        odometry.rescale(factor, np.eye(4), start, everything=True)
        self._world_begun = True
        moved = pose.copy()
        moved[:3, 3] *= factor
        return start @ moved
