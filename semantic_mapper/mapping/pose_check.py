"""Whether poses, depth and intrinsics fit each other: overlapping keyframes have to measure the same surface.

Each new keyframe's depth is carried into a few earlier ones and theirs into it, and the two depths at a pixel are
compared. The figure is the lower quartile of their relative differences, so that it stays small where a quarter of the
pixels agree, whatever moves before the camera or is hidden in one of two views: 0.2 to 0.5 % in good recordings, 1 %
with depth as noisy as a stereo camera's, 4 to 15 % with inverted poses or camera axes of another convention, 2 to 10 %
with depth that is off by a factor of two to five. Smaller errors stay unnoticed: depth that is 20 % too large, a focal
length that is 30 % too long.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.keyframes import Keyframe
from semantic_mapper.types import Float64

_log = get_logger(__name__)

MAX_DISAGREEMENT = 0.02  # fraction of the depth, median over the newest keyframes
QUARTILE = 25  # percent
WINDOW = 32  # newest keyframes that count
MIN_KEYFRAMES = 6  # that were compared, before anything is said
MIN_PIXELS = 100
PARTNERS = 3  # earlier keyframes that a new one is compared with, beside the newest
FAR = 2  # times the range of the map; depth beyond may be noise
STEP = 3  # every so many rows and columns of a keyframe's small depth image
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

# What is often wrong with a recording, as the change that would mend it.
_CAUSES: tuple[tuple[str, Callable[[Float64], Float64], float], ...] = (
    ("poses inverted (they are T_camera_world; T_world_camera is needed)", invert_pose, 1.0),
    ("camera axes turned from OpenGL's (y up, z backward) to OpenCV's", lambda T: T @ _OPENGL, 1.0),
    ("translations divided by 1000 (they are millimetres)", lambda T: _scaled(T, 0.001), 1.0),
    ("depth divided by 5 (scale 5000, not 1000)", lambda T: T, 0.2),
    ("depth multiplied by 5 (scale 1000, not 5000)", lambda T: T, 5.0),
)


class PoseCheck:
    """Compares keyframes as they come; changes nothing.

    Args:
        depth_max_m: Range of the map; depth beyond ``FAR`` times as much is not compared.

    Attributes:
        compared: Keyframes that overlap with earlier ones and were compared.
        worst: Largest ``recent`` so far; None before ``MIN_KEYFRAMES``.
        warning: What is wrong and how to mend it, for people; empty where all is well. Stays once it is there, as the
            map keeps what was fused.
    """

    def __init__(self, depth_max_m: float) -> None:
        self._limit_m = FAR * depth_max_m
        self._newest: deque[float] = deque(maxlen=WINDOW)
        self.compared = 0
        self.worst: float | None = None
        self.warning = ""

    @property
    def recent(self) -> float | None:
        """Median disagreement of the newest keyframes, fraction of the depth; None before ``MIN_KEYFRAMES``."""
        return float(np.median(self._newest)) if self.compared >= MIN_KEYFRAMES else None

    def add(self, new: Keyframe, sources: Sequence[Keyframe], keyframes: Sequence[Keyframe]) -> None:
        """Compare a new keyframe with earlier ones.

        Args:
            new: Not yet among ``keyframes``.
            sources: Of them, those that see most of what it sees, the best first.
            keyframes: All, oldest first.
        """
        chosen = [k for k in sources if not k.labelled][:PARTNERS]
        if keyframes and not keyframes[-1].labelled and not any(keyframes[-1] is k for k in chosen):
            chosen.append(keyframes[-1])
        found = disagreement([(new, k) for k in chosen], self._limit_m)
        if found is None:
            return
        self.compared += 1
        self._newest.append(found)
        recent = self.recent
        if recent is None:
            return
        self.worst = recent if self.worst is None else max(self.worst, recent)
        if recent > MAX_DISAGREEMENT and not self.warning:
            self.warning = self._explain(recent, [*keyframes, new])
            _log.warning("keyframes_contradict_each_other", seq=new.seq, camera=new.camera_id, reason=self.warning)

    def _explain(self, recent: float, keyframes: Sequence[Keyframe]) -> str:
        own = [k for k in keyframes if not k.labelled][-WINDOW:]
        text = (
            f"the depth of overlapping keyframes disagrees by {100 * recent:.1f} % (lower quartile; below 1 % where "
            f"poses and depth fit), found at frame seq={own[-1].seq}: the map cannot be trusted. Check the poses "
            "(T_world_camera, OpenCV axes, metres, stamps), the depth scale and the intrinsics"
        )
        for cause, change, depth_factor in _CAUSES:
            changed = [
                replace(k, T_world_camera=change(k.T_world_camera), depth_m=k.depth_m * np.float32(depth_factor))
                for k in own
            ]
            pairs = [disagreement([pair], self._limit_m) for pair in pairwise(changed)]
            singles = [d for d in pairs if d is not None]
            if len(singles) >= MIN_KEYFRAMES - 1 and (then := float(np.median(singles))) < MAX_DISAGREEMENT / 2:
                return f"{text}. With {cause} they disagree by {100 * then:.1f} %"
        return text


def disagreement(pairs: Sequence[tuple[Keyframe, Keyframe]], limit_m: float) -> float | None:
    """Lower quartile of |z - depth| / depth over the pixels where a keyframe's points fall on depth of its partner.

    Args:
        pairs: Compared in both directions.
        limit_m: Depth beyond is not compared.

    Returns:
        Fraction of the depth; None where fewer than ``MIN_PIXELS`` can be compared.
    """
    parts = [part for a, b in pairs for part in (_differences(a, b, limit_m), _differences(b, a, limit_m))]
    if sum(map(len, parts)) < MIN_PIXELS:
        return None
    return float(np.percentile(np.concatenate(parts), QUARTILE))


def _differences(a: Keyframe, b: Keyframe, limit_m: float) -> Float64:
    """(N,) relative differences between depth of ``a``, carried into ``b``, and the depth that ``b`` has there."""
    depth = a.depth_m[::STEP, ::STEP].astype(np.float64)
    row, column = np.nonzero((depth > 0) & (depth < limit_m))
    z, k = depth[row, column], a.intrinsics
    points = np.stack(((column * STEP - k.cx) / k.fx * z, (row * STEP - k.cy) / k.fy * z, z), axis=1)
    carried = transform(invert_pose(b.T_world_camera) @ a.T_world_camera, points)
    inside, row, column = nearest_pixels(carried, b.intrinsics)
    there = b.depth_m[row[inside], column[inside]].astype(np.float64)
    measured = (there > 0) & (there < limit_m)
    return np.abs(carried[inside, 2][measured] - there[measured]) / there[measured]


def _scaled(T: Float64, factor: float) -> Float64:
    scaled = T.copy()
    scaled[:3, 3] *= factor
    return scaled
