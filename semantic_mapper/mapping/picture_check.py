"""Whether pictures can be mapped, and whether they and their poses contradict each other.

Depth that is computed from pictures needs sharp pictures, poses that are theirs, and a lens that stays as it was
calibrated. Points found from corners and given poses are projected into the next pictures: where the corners are
elsewhere, poses do not fit; where they are farther from the centre by one factor, three times in a row, the focal
length has changed. A rolling shutter is not detected."""

from collections import Counter, OrderedDict, deque

import cv2
import numpy as np

from semantic_mapper.bundle.keyframes import Keyframe, KeyframeMap
from semantic_mapper.bundle.tracks import Tracker, Tracks, prepare_image
from semantic_mapper.geometry import invert_pose, project, rotation_vector, scale_intrinsics, transform
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

_log = get_logger(__name__)

MAX_CAMERAS = 64  # that something is kept of
# Of pictures by themselves:
_SIDE = 160  # pixels that pictures are judged in
_DARK = 24.0  # grey level that hardly any pixel of a dark picture reaches
_JUMP = 0.5  # of the mean brightness, natural logarithm, from one picture to the next
_BLUR = 0.35  # of the median sharpness of the pictures before
_SHARPNESS_OF = 15  # pictures that sharpness is compared with
# And with their poses:
_WIDTH = 320  # pixels that pictures are judged at
_CORNERS, _KEYFRAMES = 200, 6
_LEAST = 20  # corners that a judgement takes
_LEAST_DEPTH_M = 0.05
_EXPOSURE = 0.25  # change of brightness at corners from one picture to the next, natural logarithm
_CLIPPED = 245  # grey level from which on it tells nothing
_STILL = 0.002  # of the width that corners move by at most in pictures that stand still
_MOVING = 85  # percentile of the corners: most of what a camera sees that goes straight ahead hardly moves
_MOVED_M, _MOVED_RAD = 0.15, 0.05  # that poses move by at least to contradict them
_MISFIT = 0.02  # of the width by which corners may be off where given poses have them
_FOCAL = 0.03  # change of the focal length, natural logarithm ...
_FOCAL_TIMES = 3  # ... seen in so many pictures in a row
_SCALED = 0.02  # of the width by which corners may still be off once the picture is scaled
_RANSAC_PX = 2.0
_RECENT = 30  # pictures that a warning lasts
REFUSED = ("dark", "blurred", "still_pictures", "focal_change")  # would spoil a map of computed depth
SENTENCES = {
    "dark": "pictures are too dark: more light, or a longer exposure",
    "blurred": "pictures are blurred: move the camera more slowly, or give it more light",
    "exposure_jump": "the exposure jumps from picture to picture: fix it, or let it change more slowly",
    "still_pictures": "poses move, but pictures do not: is the camera frozen, or do the poses belong to another one?",
    "misfit": "poses do not fit the pictures: check their stamps, T_world_camera or T_base_camera, and the calibration",
    "focal_change": "the focal length has changed (zoom or autofocus), so the calibration does not hold: fix the lens",
}


class PictureQuality:
    """Judges the pictures of one camera by themselves, in their order."""

    def __init__(self) -> None:
        self._sharpness: deque[float] = deque(maxlen=_SHARPNESS_OF)
        self._brightness: float | None = None
        self.counters: Counter[str] = Counter()  # pictures by what was wrong, a name of ``SENTENCES``
        self.warnings: tuple[str, ...] = ()  # a sentence for each thing that is wrong with the last picture

    def look(self, rgb: UInt8) -> tuple[str, ...]:
        """Judge the next picture (H, W, 3); the names of what is wrong."""
        size = _SIDE, max(1, round(_SIDE * rgb.shape[0] / rgb.shape[1]))
        gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        before, self._brightness = self._brightness, float(np.log(gray.mean() + 1.0))
        if np.percentile(gray, 95) < _DARK:
            found = ["dark"]
        else:
            # Edges against contrast: a dim picture is as sharp as a bright one.
            sharp = float(cv2.Laplacian(gray, cv2.CV_32F).var() / (gray.var() + 1.0))
            usual = float(np.median(self._sharpness)) if len(self._sharpness) >= _SHARPNESS_OF // 3 else 0.0
            found = ["blurred"] if sharp < _BLUR * usual else []
            if before is not None and abs(self._brightness - before) > _JUMP:
                found.append("exposure_jump")
            self._sharpness.append(sharp)
        self.counters.update(found)
        self.warnings = tuple(SENTENCES[name] for name in found)
        return tuple(found)


class PictureCheck:
    """Judges the pictures of all cameras as they come; changes nothing. ``checked`` pictures were judged, ``counters``
    are pictures by what was wrong, by the names of ``SENTENCES``."""

    def __init__(self) -> None:
        self._cameras: OrderedDict[str, _CameraCheck] = OrderedDict()
        self._recent: deque[tuple[str, ...]] = deque(maxlen=_RECENT)
        self.checked = 0
        self.counters: Counter[str] = Counter()

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each thing that was wrong with recent pictures."""
        recent = {name for found in self._recent for name in found}
        return tuple(text for name, text in SENTENCES.items() if name in recent)

    @property
    def notes(self) -> list[str]:
        """A sentence for each thing that was wrong with any picture, with their number."""
        return [
            f"{self.counters[name]} of {self.checked} pictures{' (refused)' if name in REFUSED else ''}: {text}"
            for name, text in SENTENCES.items()
            if self.counters[name]
        ]

    def look(self, frame: PosedFrame) -> str:
        """Judge the next picture; why it should not be mapped, "" where it may."""
        check = self._cameras.pop(frame.camera_id, None)
        if check is None or check.intrinsics != frame.intrinsics:
            check = _CameraCheck(frame.intrinsics)
        self._cameras[frame.camera_id] = check
        if len(self._cameras) > MAX_CAMERAS:
            self._cameras.popitem(last=False)
        found = check.look(frame.rgb, frame.T_world_camera)
        self.checked += 1
        self._recent.append(found)
        self.counters.update(found)
        for name in found:
            if is_power_of_two(self.counters[name]):
                _log.warning("picture_contradicts", what=name, seq=frame.seq, camera=frame.camera_id)
        return "; ".join(SENTENCES[name] for name in found if name in REFUSED)


class _CameraCheck:
    def __init__(self, intrinsics: CameraIntrinsics) -> None:
        width = min(intrinsics.width, _WIDTH)
        self.intrinsics = intrinsics
        self._small = scale_intrinsics(intrinsics, width, round(intrinsics.height * width / intrinsics.width))
        self._tracker = Tracker(_CORNERS)
        self._points = KeyframeMap(self._small, _KEYFRAMES)
        self._pictures = PictureQuality()
        self._brightness: UInt8 | None = None
        self._anchor: tuple[Tracks, Float64] | None = None  # the last picture that had moved, and its pose
        self._focal: deque[float] = deque(maxlen=_FOCAL_TIMES)
        self._count = 0

    def look(self, rgb: UInt8, T_world_camera: Float64) -> tuple[str, ...]:
        found = [name for name in self._pictures.look(rgb) if name in ("dark", "blurred")]
        if found:  # corners are followed from the picture before into the next good one
            return tuple(found)
        k = self._small
        before = self._tracker.tracks
        tracks = self._tracker.advance(prepare_image(rgb, k.width, k.height))
        if self._exposure_jumps(rgb, before, tracks):
            found.append("exposure_jump")
        if self._stands_still(tracks, T_world_camera):
            found.append("still_pictures")
        error, focal = self._compare(tracks, T_world_camera)
        self._focal.append(0.0 if "still_pictures" in found else focal)
        if error > _MISFIT:
            found.append("misfit")
        changes = np.array(self._focal)
        if len(changes) == _FOCAL_TIMES and ((changes > _FOCAL).all() or (changes < -_FOCAL).all()):
            found.append("focal_change")
        if self._points.wants_keyframe(tracks):
            tracks = self._tracker.replenish()
            self._points.add(Keyframe(self._count, tracks, T_world_camera, T_world_camera, (1.0, 1.0)))
            self._count += 1
        return tuple(found)

    def _exposure_jumps(self, rgb: UInt8, before: Tracks, after: Tracks) -> bool:
        """Whether the same corners are brighter or darker than in the picture before."""
        size = self._small.width, self._small.height
        gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
        last, self._brightness = self._brightness, np.asarray(cv2.blur(gray, (7, 7)), np.uint8)
        if last is None or len(after.ids) < _LEAST:
            return False
        values = [
            image[tuple(np.rint(pixels[:, ::-1]).astype(int).T)].astype(np.float64)
            for image, pixels in ((last, before.pixels[before.rows(after.ids)]), (self._brightness, after.pixels))
        ]
        known = (values[0] < _CLIPPED) & (values[1] < _CLIPPED)
        if known.sum() < _LEAST:
            return bool((values[0] >= _CLIPPED).mean() < 0.5 <= (values[1] >= _CLIPPED).mean())
        return abs(float(np.median(np.log((values[1][known] + 2) / (values[0][known] + 2))))) > _EXPOSURE

    def _stands_still(self, tracks: Tracks, T_world_camera: Float64) -> bool:
        """Whether poses have moved since the last picture that had; a slow camera moves sooner or later."""
        if self._anchor is not None:
            before, pose = self._anchor
            ids = before.ids[np.isin(before.ids, tracks.ids)]
            ways = tracks.pixels[tracks.rows(ids)] - before.pixels[before.rows(ids)]
            if len(ids) >= _LEAST and np.percentile(np.linalg.norm(ways, axis=1), _MOVING) < _STILL * self._small.width:
                moved = invert_pose(pose) @ T_world_camera
                metres, radians = np.linalg.norm(moved[:3, 3]), np.linalg.norm(rotation_vector(moved))
                return bool(metres > _MOVED_M or radians > _MOVED_RAD)
        self._anchor = tracks, T_world_camera
        return False

    def _compare(self, tracks: Tracks, T_world_camera: Float64) -> tuple[float, float]:
        """Median distance of corners from where the pose has their points, as a fraction of the width; and by how much
        they are all farther from the centre, natural logarithm; 0 where they are off otherwise, too."""
        mask, points = self._points.known(tracks)
        if mask.sum() < _LEAST:
            return 0.0, 0.0
        in_camera = transform(invert_pose(T_world_camera), points)
        front = in_camera[:, 2] > _LEAST_DEPTH_M
        if front.sum() < _LEAST:
            return 0.0, 0.0
        k = self._small
        centre = np.array((k.cx, k.cy))
        expected, seen = project(in_camera[front], k) - centre, tracks.pixels[mask][front] - centre
        error = float(np.median(np.linalg.norm(seen - expected, axis=1)))
        cv2.setRNGSeed(1)
        M, _ = cv2.estimateAffinePartial2D(expected, seen, method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_PX)
        if M is None:
            return error / k.width, 0.0
        left = float(np.median(np.linalg.norm(seen - expected @ M[:, :2].T - M[:, 2], axis=1)))
        focal = float(np.log(np.hypot(M[0, 0], M[1, 0])))
        return error / k.width, focal if left < _SCALED * k.width else 0.0
