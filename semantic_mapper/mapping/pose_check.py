"""Whether poses, depth, intrinsics and pictures fit each other: overlapping keyframes have to measure the same surface.

Each new keyframe's depth is carried into some earlier ones and theirs into it. The disagreement is the lower quartile
of the relative differences, so that it stays small whatever moves or is hidden: 0.2 to 0.5 % in good recordings, 1 %
with a stereo camera's noise, 4 to 15 % with inverted poses or camera axes of another convention.

A pair contradicts itself where one sees through what the other measures: in good recordings in at most 8 % of the
pixels. Where the poses jump or drift, only the pairs across the jump do: so the oldest of the neighbourhood are
compared, too, and a tenth of the pairs is enough for a warning. What moves is seen through between neighbours in time
as well: that is taken off. Unnoticed stay depth 20 % too large, a focal length 10 % too long, a drift of 20 cm.

Poses that stand still give no pairs, and pictures may not show one view after the other. A quarter of the parts of a
still camera's pictures correlate by 0.99, also where people walk; in a walk through a kitchen 0.3 after 1.5 s."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.keyframes import Keyframe, pose_distances
from semantic_mapper.types import Float32, Float64, PosedFrame, UInt8

_log = get_logger(__name__)

MAX_DISAGREEMENT = 0.02  # fraction of the depth, median over the newest keyframes
QUARTILE = 25  # percent
MAX_CONTRADICTING = 0.1  # fraction of the newest pairs
SEEN_THROUGH = 0.12  # fraction of a pair's pixels, beyond what moves, from which on it contradicts itself
BEFORE = 0.1  # fraction of the depth that a point lies before it
MIN_OVERLAP = 0.3  # fraction of a pair's pixels that can be compared, where it is to be judged by itself
WINDOW = 32  # newest keyframes that count
PAIR_WINDOW = 128  # newest pairs that count: those of about 20 keyframes
MIN_KEYFRAMES = 6  # that were compared, before anything is said
MIN_PIXELS = 100
MIN_PAIRS = 32  # before contradicting ones are counted
PARTNERS = 3  # earlier keyframes that a new one is compared with, next to the newest
OLDEST = 4  # of its neighbourhood, as many again
NEIGHBOURS_M, NEIGHBOURS_DEG = 2.0, 40.0  # what counts as its neighbourhood
FAR = 2  # times the range of the map; depth beyond may be noise
STEP = 3  # every n rows and columns of a keyframe's small depth image
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_REP_103 = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # T_body_camera
STILL_M, STILL_DEG = 1e-3, 0.1  # that a pose which stands still may change by
STILL_VIEWS, STILL_FRAMES = 6, 600  # different views at one pose that contradict it, and frames among which they are
SAME_VIEW = 0.5  # correlation from which on parts of two pictures show the same
_SIZE, _PARTS = (80, 60), (6, 10, 8, 10)  # of a picture that is compared; rows of parts, pixels, columns, pixels
_TEXTURED = 6.0  # grey levels that a part with texture varies by
ALIKE = 0.8  # of the overlap that keyframes have as they are; a cause that leaves less has but moved them apart


def _in_metres(T: Float64) -> Float64:
    scaled = T.copy()
    scaled[:3, 3] *= 0.001
    return scaled


# What is often wrong with a recording, as the change that would fix it.
_CAUSES: tuple[tuple[str, Callable[[Float64], Float64], float], ...] = (
    ("poses inverted (they are T_camera_world; T_world_camera is needed)", invert_pose, 1.0),
    ("camera axes turned from OpenGL's (y up, z backward) to OpenCV's", lambda T: T @ _OPENGL, 1.0),
    ("camera axes turned from a robot's (REP 103: x forward, y left, z up) to OpenCV's", lambda T: T @ _REP_103, 1.0),
    ("translations divided by 1000 (they are millimetres)", _in_metres, 1.0),
    ("depth divided by 5 (scale 5000, not 1000)", lambda T: T, 0.2),
    ("depth multiplied by 5 (scale 1000, not 5000)", lambda T: T, 5.0),
    *((f"depth multiplied, or positions divided, by {f:.3g}", lambda T: T, f) for f in (0.1, 1 / 3, 0.5, 2, 3, 10)),
)


class PoseCheck:
    """Compares keyframes, and pictures at one pose, as they come; changes nothing. ``compared`` keyframes overlap with
    earlier ones; ``worst`` and ``worst_contradicting`` are the largest ``recent`` and ``contradicting`` so far.
    ``warning`` says what is wrong and how to fix it; it stays, as the map keeps what was fused, until keyframes move
    (``compare_again``)."""

    def __init__(self, depth_max_m: float) -> None:
        self._limit_m = FAR * depth_max_m
        self._newest: deque[float] = deque(maxlen=WINDOW)
        self._pairs: deque[float] = deque(maxlen=PAIR_WINDOW)
        self._places: dict[str, tuple[Float64, int, list[Float32]]] = {}  # camera -> pose, since which frame, views
        self._frames = 0
        self._moving: dict[tuple[str, int], float] = {}  # keyframe -> fraction seen through against the one before it
        self._measured: set[tuple[str, int]] = set()  # keyframes that were given to ``add``
        self.compared = 0
        self.worst: float | None = None
        self.worst_contradicting: float | None = None
        self.warning = self._stands_still = ""

    @property
    def recent(self) -> float | None:
        """Median disagreement of the newest keyframes, fraction of the depth; None before ``MIN_KEYFRAMES``."""
        return float(np.median(self._newest)) if self.compared >= MIN_KEYFRAMES else None

    @property
    def contradicting(self) -> float | None:
        """Fraction of the newest pairs of which one sees through what the other measures; None: too few overlap."""
        if self.compared < MIN_KEYFRAMES or len(self._pairs) < MIN_PAIRS:
            return None
        return float(np.mean(np.array(self._pairs) > SEEN_THROUGH))

    def look(self, frame: PosedFrame) -> None:
        """Compare the picture of any frame with those before it whose pose was the same."""
        if self.warning:
            return
        self._frames += 1
        pose, since, views = self._places.get(frame.camera_id, (frame.T_world_camera, self._frames, []))
        metres, degrees = pose_distances(pose, frame.T_world_camera)
        if metres > STILL_M or degrees > STILL_DEG or self._frames - since > STILL_FRAMES:
            pose, since, views = frame.T_world_camera, self._frames, []
        new = _view_of(frame.rgb)
        known = next((n for n, view in enumerate(views) if _is_same_view(view, new)), len(views))
        # Views after a known one were of something that came between, and has left: the camera has not moved.
        self._places[frame.camera_id] = pose, since, [*views, new][: known + 1]
        if known + 1 >= STILL_VIEWS:
            self.warning = self._stands_still = (
                f"poses stand still while the camera moves: {STILL_VIEWS} different views at one pose up to frame "
                f"seq={frame.seq}: the map cannot be trusted. Check that each frame has its own pose (lost tracking?)"
            )
            _log.warning("poses_stand_still", seq=frame.seq, camera=frame.camera_id, reason=self.warning)

    def add(self, new: Keyframe, sources: Sequence[Keyframe], keyframes: Sequence[Keyframe]) -> None:
        """Compare a new keyframe with ``sources``, which see most of what it sees, best first; others oldest first."""
        self._measured = {_key(new), *self._measured.intersection(map(_key, keyframes))}
        near = [k for k in sources if not k.labelled][:PARTNERS]
        if keyframes and not keyframes[-1].labelled and not any(keyframes[-1] is k for k in near):
            near.append(keyframes[-1])
        found = disagreement([(new, k) for k in near], self._limit_m)
        if found is None:
            return
        self.compared += 1
        self._newest.append(found)
        self._compare_pairs(new, [*near, *_oldest_neighbours(new, keyframes, near)], keyframes)
        recent, contradicting = self.recent, self.contradicting
        self.worst = max((v for v in (self.worst, recent) if v is not None), default=None)
        worst = (v for v in (self.worst_contradicting, contradicting) if v is not None)
        self.worst_contradicting = max(worst, default=None)
        if self.warning or recent is None:
            return
        if recent > MAX_DISAGREEMENT or (contradicting or 0.0) > MAX_CONTRADICTING:
            self.warning = self._explain(recent, contradicting, [*keyframes, new])
            _log.warning("keyframes_contradict_each_other", seq=new.seq, camera=new.camera_id, reason=self.warning)

    def compare_again(self, keyframes: Sequence[Keyframe]) -> None:
        """Compare keyframes, oldest first, where a correction has moved them, in place of where they were."""
        measured = self._measured
        self._newest.clear()
        self._pairs.clear()
        self._moving.clear()
        self.compared, self.worst, self.worst_contradicting, self.warning = 0, None, None, self._stands_still
        for i, keyframe in enumerate(keyframes):
            if _key(keyframe) in measured:
                self.add(keyframe, (), keyframes[:i])

    def _compare_pairs(self, new: Keyframe, partners: Sequence[Keyframe], keyframes: Sequence[Keyframe]) -> None:
        kept = {_key(k) for k in keyframes}
        self._moving = {key: moving for key, moving in self._moving.items() if key in kept}
        before = next((k for k in reversed(keyframes) if k.camera_id == new.camera_id and not k.labelled), None)
        moving = fraction_seen_through(new, before, self._limit_m) if before is not None else None
        if before is not None and moving is not None:
            self._moving[_key(new)] = moving
            self._moving.setdefault(_key(before), moving)  # the first of its camera has none before it
        for k in partners:
            seen_through = fraction_seen_through(new, k, self._limit_m)
            if seen_through is not None:
                moves = max(self._moving.get(_key(new), 0.0), self._moving.get(_key(k), 0.0))
                self._pairs.append(seen_through - moves)

    def _explain(self, recent: float, contradicting: float | None, keyframes: Sequence[Keyframe]) -> str:
        own = [k for k in keyframes if not k.labelled][-WINDOW:]
        what = f"the depth of overlapping keyframes disagrees by {100 * recent:.1f} % (below 1 % where all fits)"
        if recent <= MAX_DISAGREEMENT:
            what = (
                f"in {100 * (contradicting or 0.0):.0f} % of the pairs of overlapping keyframes, one sees through what "
                "the other measures (none do where all fits)"
            )
        needed = ALIKE * _overlap(own, self._limit_m)
        best, least = "", min(MAX_DISAGREEMENT, recent) / 2
        for cause, change, depth_factor in _CAUSES:
            factor = np.float32(depth_factor)
            changed = [replace(k, T_world_camera=change(k.T_world_camera), depth_m=k.depth_m * factor) for k in own]
            pairs = [disagreement([pair], self._limit_m) for pair in pairwise(changed)]
            singles = [d for d in pairs if d is not None]
            if len(singles) < MIN_KEYFRAMES - 1 or _overlap(changed, self._limit_m) < needed:
                continue
            then = float(np.median(singles))
            if then < least:
                best, least = f". With {cause} they disagree by {100 * then:.1f} %", then
        return (
            f"{what}, found at frame seq={own[-1].seq}: the map cannot be trusted. Check the poses (T_world_camera, "
            f"OpenCV axes, metres, stamps), the depth scale and the intrinsics{best}"
        )


def disagreement(pairs: Sequence[tuple[Keyframe, Keyframe]], limit_m: float) -> float | None:
    """Lower quartile of |z - depth| / depth over the pixels where a keyframe's points fall on depth of its partner, in
    both directions; None where fewer than ``MIN_PIXELS`` can be compared."""
    parts = [part for a, b in pairs for part in (_differences(a, b, limit_m)[0], _differences(b, a, limit_m)[0])]
    if sum(map(len, parts)) < MIN_PIXELS:
        return None
    return float(np.percentile(np.abs(np.concatenate(parts)), QUARTILE))


def _overlap(keyframes: Sequence[Keyframe], limit_m: float) -> float:
    """Fraction of the pixels of each keyframe that fall on depth of the next one, mean."""
    found = [_differences(a, b, limit_m) for a, b in pairwise(keyframes)]
    return float(np.mean([len(differences) / max(of, 1) for differences, of in found])) if found else 0.0


def fraction_seen_through(a: Keyframe, b: Keyframe, limit_m: float) -> float | None:
    """Fraction of the pixels where points of one keyframe lie before the depth of the other by more than ``BEFORE``;
    None where the two overlap in less than ``MIN_OVERLAP`` of their pixels with depth."""
    (there, of_a), (back, of_b) = _differences(a, b, limit_m), _differences(b, a, limit_m)
    compared = len(there) + len(back)
    if compared < max(MIN_PIXELS, MIN_OVERLAP * (of_a + of_b)):
        return None
    return float((np.count_nonzero(there < -BEFORE) + np.count_nonzero(back < -BEFORE)) / compared)


def _view_of(rgb: UInt8) -> Float32:
    """Parts of a picture (H, W, 3), (parts, pixels) grey without their mean, of length 1, or 0 without texture."""
    gray = cv2.cvtColor(cv2.resize(rgb, _SIZE, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
    parts = gray.reshape(_PARTS).swapaxes(1, 2).reshape(_PARTS[0] * _PARTS[2], -1).astype(np.float32)
    parts -= parts.mean(axis=1, keepdims=True)
    length = np.linalg.norm(parts, axis=1, keepdims=True)
    return np.where(length > _TEXTURED * parts.shape[1] ** 0.5, parts / np.maximum(length, 1), 0)


def _is_same_view(a: Float32, b: Float32) -> bool:
    """Whether a quarter of the parts with texture correlate; True where there are too few of them to tell."""
    correlation = (a * b).sum(axis=1)[(a.any(axis=1) | b.any(axis=1))]
    return len(correlation) < len(a) / 4 or bool(np.percentile(correlation, 75) > SAME_VIEW)


def _oldest_neighbours(new: Keyframe, keyframes: Sequence[Keyframe], but: Sequence[Keyframe]) -> list[Keyframe]:
    """Up to ``OLDEST`` keyframes that look from about the same place in about the same direction."""
    others = [k for k in keyframes if not k.labelled and not any(k is other for other in but)]
    if not others:
        return []
    moved, turned = pose_distances(np.array([k.T_world_camera for k in others]), new.T_world_camera)
    near = (moved < NEIGHBOURS_M) & (turned < NEIGHBOURS_DEG)
    return [others[i] for i in np.flatnonzero(near)[:OLDEST]]


def _differences(a: Keyframe, b: Keyframe, limit_m: float) -> tuple[Float64, int]:
    """Depth of ``a``, carried into ``b``, less the depth that ``b`` has there, (N,) as fractions of the depth of
    ``b``; and how many pixels of ``a`` were carried."""
    depth = a.depth_m[::STEP, ::STEP].astype(np.float64)
    row, column = np.nonzero((depth > 0) & (depth < limit_m))
    z, k = depth[row, column], a.intrinsics
    points = np.stack(((column * STEP - k.cx) / k.fx * z, (row * STEP - k.cy) / k.fy * z, z), axis=1)
    carried = transform(invert_pose(b.T_world_camera) @ a.T_world_camera, points)
    inside, row, column = nearest_pixels(carried, b.intrinsics)
    there = b.depth_m[row[inside], column[inside]].astype(np.float64)
    measured = (there > 0) & (there < limit_m)
    return (carried[inside, 2][measured] - there[measured]) / there[measured], len(z)


def _key(keyframe: Keyframe) -> tuple[str, int]:
    return keyframe.camera_id, keyframe.seq
