"""Where the depth of a frame comes from: its sensor, the pictures of a moving camera, or neither."""

import math
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from semantic_mapper.bundle.refiner import PoseRefiner
from semantic_mapper.config import DepthConfig
from semantic_mapper.depth_from_motion.stream import MAX_CAMERAS, DepthFromMotion
from semantic_mapper.depth_from_motion.views import DepthEstimate
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.geometry import check_pose
from semantic_mapper.mapping.picture_check import PictureCheck
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, PosedFrame

SURE_SPREAD = 0.03  # spread, as a fraction of depth, up to which computed depth has its full weight
MOST_SPREAD = 0.10  # from here on it has none
HINT_SPREAD = 0.04  # of the map's own surface where it was computed, as a fraction of depth
MEASURED_SPREAD = 0.01  # and where it was measured
RECENT_FRAMES = 500
REFINED_WIDTH = 320  # pixels; corners of smaller images are too inexact to check or correct poses by

MOST_TRUST = 1.0  # of a rendered depth
GUESS_TRUST = 0.1  # where the map has no surface yet
LEAST_TRUST = 0.05  # below, nothing is fused
ROUGHNESS = 0.003  # fraction of z by which a pixel may leave the line between its neighbours: trust falls to 1 / e

CastMap = Callable[[PosedFrame, CameraIntrinsics], tuple[Float32, Bool]]


class FrameDepth:
    """Gives frames the depth that the settings ask for.

    ``cast_map`` gives depth (h, w) of the map as a frame sees it, 0 = no surface, and whether it was measured (h, w)
    bool. ``pictures`` knows what was wrong with pictures that depth was to be computed from."""

    def __init__(self, config: DepthConfig, cast_map: CastMap) -> None:
        self._config = config
        self._cast_map = cast_map
        self._refiners: OrderedDict[str, tuple[CameraIntrinsics, PoseRefiner]] = OrderedDict()
        self._disagreement: deque[tuple[float, float]] = deque(maxlen=RECENT_FRAMES)
        self.pictures = PictureCheck()
        self._computer: DepthFromMotion | None = None
        if config.source in ("auto", "computed"):
            self._computer = DepthFromMotion(config.from_motion)

    @property
    def disagreement_px(self) -> tuple[float, float] | None:
        """Median distance in pixels of corners from where given poses have them, and where refined poses do, of the
        last frames whose depth was computed; None where there were none."""
        if not self._disagreement:
            return None
        given, refined = np.median(np.array(self._disagreement), axis=0)
        return float(given), float(refined)

    def give(self, frame: PosedFrame) -> PosedFrame:
        """A frame with its depth, where frames do not wait for later ones; ``ConfigError`` where they do, and this one
        does not come from ``push``."""
        if self._computer is None or self._config.from_motion.delay_frames == 0:
            (ready,) = self.push(frame)
            return ready
        if frame.depth_sigma_m is None and (frame.depth_m is None or self._config.source == "computed"):
            raise ConfigError("depth.from_motion.delay_frames lets frames wait: give step what prepare returns")
        return frame

    def push(self, frame: PosedFrame) -> list[PosedFrame]:
        """Take a frame; the frames that are ready, oldest first. One whose depth is computed may wait for later ones.

        A frame with a spread of its depth is left as it is; with ``source`` "sensor" or "off" its depth is left out.
        ``FrameError``: a picture that would spoil the map; see ``PictureCheck``."""
        where = f"frame seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.depth_sigma_m is not None:
            return [frame if self._computer is not None else replace(frame, depth_m=None, depth_sigma_m=None)]
        if self._config.source in ("off", "computed") and frame.depth_m is not None:
            frame = replace(frame, depth_m=None)
        if self._computer is None or frame.depth_m is not None:
            return [frame] if self._computer is None else self._computer.push(frame)
        done: list[PosedFrame] = []
        if frame.intrinsics.width >= REFINED_WIDTH:
            if why := self.pictures.look(frame):
                raise FrameError(f"{where}: {why}")
            if self._config.refine_poses:
                if self._lens_changed(frame):
                    done = self.finish()  # frames that wait are in the world of the refiner that goes
                frame = self._refine(frame, self._computer)
        return done + [self._anchored(f) for f in self._computer.push(frame, self._hint)]

    def finish(self) -> list[PosedFrame]:
        """The frames that still wait, oldest first."""
        return [] if self._computer is None else [self._anchored(f) for f in self._computer.finish()]

    def _anchored(self, frame: PosedFrame) -> PosedFrame:
        """A frame with computed depth where the given poses have it in the mean; its spread has that of their scale."""
        _, refiner = self._refiners.get(frame.camera_id, (None, None))
        if refiner is None or frame.depth_sigma_m is None:
            return frame
        assert frame.depth_m is not None
        sigma_m = np.hypot(frame.depth_sigma_m, np.float32(min(refiner.scale_spread, 1.0)) * frame.depth_m)
        pose, scale = refiner.to_given(frame.T_world_camera)
        depth_m, sigma_m = np.float32(scale) * frame.depth_m, np.float32(scale) * sigma_m.astype(np.float32)
        return replace(frame, T_world_camera=pose, depth_m=depth_m, depth_sigma_m=sigma_m)

    def _lens_changed(self, frame: PosedFrame) -> bool:
        intrinsics, _ = self._refiners.get(frame.camera_id, (frame.intrinsics, None))
        return intrinsics != frame.intrinsics

    def _refine(self, frame: PosedFrame, computer: DepthFromMotion) -> PosedFrame:
        """The frame at a pose that fits the pictures; a camera with another lens or size starts over."""
        starts = self._lens_changed(frame)
        _, refiner = self._refiners.pop(frame.camera_id, (None, None))
        if refiner is None or starts:
            background = self._config.refine_in_background
            refiner = PoseRefiner(frame.intrinsics, self._config.poses, background=background)
        self._refiners[frame.camera_id] = frame.intrinsics, refiner
        if len(self._refiners) > MAX_CAMERAS:
            self._refiners.popitem(last=False)
        refined = refiner.push(frame)
        if math.isfinite(refined.given_error_px) and math.isfinite(refined.error_px):
            self._disagreement.append((refined.given_error_px, refined.error_px))
        computer.correct_poses(refiner.corrections())
        return replace(frame, T_world_camera=refined.T_world_camera)

    def _hint(self, frame: PosedFrame, intrinsics: CameraIntrinsics) -> DepthEstimate:
        """What the map says of the depth of a frame, (h, w)."""
        _, refiner = self._refiners.get(frame.camera_id, (None, None))
        scale = 1.0
        if refiner is not None:
            T_world_camera, scale = refiner.to_given(frame.T_world_camera)
            frame = replace(frame, T_world_camera=T_world_camera)
        depth_m, measured = self._cast_map(frame, intrinsics)
        depth_m = depth_m / np.float32(scale)  # as the refined poses, which it is compared by, have it
        spread = np.where(measured, np.float32(MEASURED_SPREAD), np.float32(HINT_SPREAD))
        return DepthEstimate(depth_m, (spread * depth_m).astype(np.float32))


def computed_trust(depth_m: Float32, sigma_m: Float32) -> Float32:
    """Fraction (H, W) of its full weight that computed depth has: the inverse variance, relative to that of
    ``SURE_SPREAD``, and nothing where little is known. ``sigma_m`` is the one-sigma spread of ``depth_m``, 0 = none."""
    spread = sigma_m / np.maximum(depth_m, np.float32(1e-3))
    trust = np.minimum(1.0, (SURE_SPREAD / np.maximum(spread, np.float32(1e-6))) ** 2)
    return np.where((depth_m > 0) & (spread < MOST_SPREAD), trust, 0).astype(np.float32)


def rendered_trust(depth_m: Float32, map_depth_m: Float32, truncation_m: float) -> Float32:
    """Fraction (h, w) of its full weight that depth has which a field rendered; 0 where there is nothing to fuse.

    It is a mean along each ray: at edges and where samples disagree it leaves the smooth surface of its neighbours, and
    it has to lie near the map's surface. Trust falls with both differences, to 1 / e half a truncation away. Beyond the
    map a field mostly guesses: there many looks have to agree. Depths are 0 where nothing is known."""
    roughness = np.maximum(_bend(depth_m, 0), _bend(depth_m, 1)) / np.maximum(depth_m, np.float32(1e-3))
    cost = (roughness / ROUGHNESS) ** 2
    off = 2 * (depth_m - map_depth_m) / truncation_m
    cost += np.where(map_depth_m > 0, off * off, 0)
    trust = np.where(map_depth_m > 0, MOST_TRUST, GUESS_TRUST) * np.exp(-cost)
    return np.where((depth_m > 0) & (trust >= LEAST_TRUST), trust, 0).astype(np.float32)


def _bend(depth_m: Float32, axis: int) -> Float32:
    """How far each pixel lies from the line between its two neighbours along an axis; inf next to unknown ones."""
    known = np.where(depth_m > 0, depth_m, np.inf)
    padded = np.pad(known, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect")
    before, after = (padded[:-2], padded[2:]) if axis == 0 else (padded[:, :-2], padded[:, 2:])
    with np.errstate(invalid="ignore"):
        bend = np.abs(0.5 * (before + after) - known)
    return np.where(np.isfinite(bend), bend, np.inf).astype(np.float32)
