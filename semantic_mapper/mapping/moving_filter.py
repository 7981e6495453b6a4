"""Which pixels of frames are left out of a map because they show what moves: when they come, and in a rebuild."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.labels import MOVING_NAMES, LabelSet
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.mapping.moving import BEYOND_M, EVERY_S, SETTLED_S, MotionDetector, MovingSpace
from semantic_mapper.types import Bool, PosedFrame, UInt8

_log = get_logger(__name__)

EDGE_PX = 2  # around what moves, where depth may be between it and what is behind

RECENT = 30  # frames that a warning is about
MUCH = 0.3  # fraction of the pixels; where half of the frames leave out more, people are warned
POSES_OFF = (
    "moving: poses do not fit the depth of the seconds before, so nothing is left out as moving: check their stamps, "
    "T_world_camera or T_base_camera and the calibration; moving.motion = false ends the search"
)
MUCH_LEFT_OUT = (
    f"moving: more than {MUCH:.0%} of the pixels are left out as moving and not mapped: either something fills the "
    "picture, or poses drift: check them against the map; moving.motion = false maps what does not move by its class"
)


class MovingFilter:
    """Of one map.

    Args:
        config: Of the mapper.
        label_set: Of the map.

    Attributes:
        pixels: Left out so far.
        space: Where what moves was within the last second.
        uses_classes: Whether classes of ``label_set`` move.
        warning: What is wrong with the last ``RECENT`` frames and how to mend it, for people; empty where all is well.

    Raises:
        ConfigError: ``moving.classes``, and none of the classes does.
    """

    def __init__(self, config: MapperConfig, label_set: LabelSet) -> None:
        self._config = config
        self._motion = MotionDetector(config.voxel_map.depth_max_m)
        self._ids = label_set.moving_ids() if config.moving.classes else ()
        if config.moving.classes and not self._ids:
            names = ", ".join(sorted(MOVING_NAMES))
            raise ConfigError(
                f"moving.classes: none of the classes of '{label_set.name}' moves by itself ({names} would); use "
                "weights that know one (`rooms-people` ship), or moving.motion"
            )
        self.pixels = 0
        self.warning = ""
        self._recent: deque[tuple[bool, float]] = deque(maxlen=RECENT)  # whether poses fit; fraction that moves
        self._warned = 0
        self.space = MovingSpace()

    @property
    def uses_classes(self) -> bool:
        """Whether classes of the map move by themselves."""
        return bool(self._ids)

    @property
    def on(self) -> bool:
        """Whether anything is looked for."""
        return self._config.moving.motion or self._config.moving.classes

    def find(self, frame: PosedFrame) -> Bool:
        """Pixels (H, W) of what moves by depth, of a frame whose depth was measured."""
        if not self._config.moving.motion:
            return np.zeros(frame.rgb.shape[:2], np.bool_)
        return self._motion.find(frame)

    def of_classes(self, label: UInt8) -> Bool:
        """Pixels (H, W) whose class moves by itself."""
        return np.isin(label, self._ids)

    def note(self, frame: PosedFrame, moving: Bool) -> None:
        """Count what was left out of a frame (its depth as it came), and keep for a second where that was."""
        self.pixels += int(moving.sum())
        self.space.add(frame, moving)
        self._recent.append((self._motion.poses_fit, float(moving.mean())))
        before, self.warning = self.warning, self._judge()
        if self.warning and self.warning != before:
            self._warned += 1
            if is_power_of_two(self._warned):
                _log.warning("motion_is_in_doubt", seq=frame.seq, camera=frame.camera_id, reason=self.warning)

    def _judge(self) -> str:
        fit, fraction = np.array(self._recent).T
        if len(fit) < RECENT:
            return ""
        if fit.mean() < 0.5:
            return POSES_OFF
        return MUCH_LEFT_OUT if np.median(fraction) > MUCH else ""

    def leave_out(self, frame: PosedFrame, moving: Bool) -> PosedFrame:
        """The frame without depth where it shows what moves, and at its edges: neither surface nor seen through."""
        assert frame.depth_m is not None
        nothing = BEYOND_M if self._config.voxel_map.no_return_range_m > 0 else np.float32(0)
        wider = cv2.dilate(moving.astype(np.uint8), np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)) > 0
        return replace(frame, depth_m=np.where(wider, nothing, frame.depth_m))

    def clear(self) -> None:
        """Forget the last seconds: poses of frames to come are in another world."""
        self._motion.clear()
        self.space.clear()
        self._recent.clear()
        self.warning = ""

    def again(self, *, whole: bool) -> MovingAgain:
        """What decides once more in a rebuild; ``whole``: it begins with the first frame of the map."""
        return MovingAgain(self, MotionDetector(self._config.voxel_map.depth_max_m), whole)

    def adopt(self, motion: MotionDetector) -> None:
        """Go on with what a rebuild has seen of the last seconds, at the poses that are right now."""
        self._motion = motion


class MovingAgain:
    """Decides by corrected poses what moved in the frames of a history. Made by ``MovingFilter.again``."""

    def __init__(self, filter_: MovingFilter, motion: MotionDetector, whole: bool) -> None:
        self._filter = filter_
        self._motion = motion
        self._sure_from_ns: int | None = 0 if whole else None

    def without_moving(self, frame: PosedFrame, by_motion: Bool, by_class: Bool) -> PosedFrame:
        """A frame without what moves.

        Args:
            frame: With its depth as it came, at its corrected pose; the next one of the history.
            by_motion: (H, W) what was found when it came. Stands where the rebuild does not know the seconds before.
            by_class: (H, W) the same by class, which stands.
        """
        found = self._motion.find(frame)
        if self._sure_from_ns is None:
            self._sure_from_ns = frame.stamp_ns + round((SETTLED_S + EVERY_S) * 1e9)
        moving = by_class | (found if frame.stamp_ns >= self._sure_from_ns else by_motion)
        return self._filter.leave_out(frame, moving) if moving.any() else frame

    def adopt(self) -> None:
        """The rebuilt map is in use from now on."""
        self._filter.adopt(self._motion)
