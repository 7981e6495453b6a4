"""A film becomes a log: frames chosen, poses found, scale and up found, and what lies between filled in."""

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import cv2
import msgspec
import numpy as np

from semantic_mapper.bundle.scale import Floor, find_floor
from semantic_mapper.drivers.calibration import Rectifier, load_calibration
from semantic_mapper.drivers.poses.board import BoardFinder
from semantic_mapper.errors import ConfigError, FrameError, ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.geometry import scale_intrinsics, transform
from semantic_mapper.imaging import rotate_intrinsics
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.format import atomic_log
from semantic_mapper.replay.sfm import colmap, refusals
from semantic_mapper.replay.sfm.between import RegisteredFrame, follow_pose
from semantic_mapper.replay.sfm.film import (
    LEAST_MOTION,
    STEP,
    Film,
    FilmFrame,
    FilmLook,
    FilmNote,
    find_features,
    look_through,
    pick_frames,
)
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, place_by_gps
from semantic_mapper.replay.sfm.scale import (
    FLOOR_KEY,
    MIN_BOARD_CORNERS,
    UNSCALED_DEPTH_M,
    ScaleHint,
    describe_floor,
    find_edges,
    median_depth,
    scale_by_board,
    scale_by_floor,
    scene_depth,
    upright,
    vertical,
)
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64, Int64, PosedFrame, UInt8

FOCAL_PRIORS = (0.85, 1.2, 0.65)  # of the longer side, in the order of trial: phones, webcams, wide lenses
RETRY_PRIORS = (1.0, 0.85, 1.2)  # of the focal length that was given as a guess
FILL = 0.02  # motion between two frames of the log, of the image's width
FILL_NS, FILL_LEAST = 140_000_000, LEAST_MOTION  # ... or this long after the last one, with this much motion
MAX_FRAMES = 3000  # in a log; longer ways get longer steps
FOLLOWED = 2.5 * STEP  # motion since the last registered frame within which a frame is followed
MAX_POINT_ERROR_PX = 2.0  # points that are less exact are no guide
EDGE_FRAMES = 60  # about as many are searched for upright edges
PACKING = CodecOptions(rgb="jpeg", jpeg_quality=95)  # a film has lost more already

FLOOR_CONE_DEG = 12.0  # how far up may be off where no edges tell it

CAMERA_ID = "camera"  # in the log

Progress = Callable[[str, int, int], None]  # what is done; how much of it; of how much


@dataclass(frozen=True, slots=True)
class FilmOptions:
    """How to read a film."""

    calibration: Path | None = None  # file of the camera's calibration; None = focal length and distortion are found
    focal_prior_px: float | None = None  # about the focal length, in pixels of the film; None = guessed, or by EXIF
    scale: ScaleHint = field(default_factory=ScaleHint)  # what tells the size of the scene
    quarters: int = 0  # turn every frame clockwise by this many quarters


@dataclass(frozen=True, slots=True, eq=False)
class FilmReport:
    """What became of a film."""

    note: FilmNote  # as the log keeps it
    left_out: tuple[str, ...]  # stretches of frames that are not in the log, in order: when, and why
    points: int  # of the model
    focal_source: str  # where the focal length comes from
    distortion: tuple[float, ...]  # OpenCV's coefficients
    scale: str  # how the scale was found; empty = unknown
    height_m: float | None  # median height of the camera over the floor; None where no floor is found
    T_world_camera: Float64  # (N, 4, 4) of the N frames in the log
    notices: tuple[str, ...]  # sentences on what had to be assumed

    @property
    def path_m(self) -> float:
        """Length of the way; in the log's own unit where the scale is unknown."""
        return float(np.linalg.norm(np.diff(self.T_world_camera[:, :3, 3], axis=0), axis=1).sum())


def import_film(
    src: Path, dst: Path, options: FilmOptions, on_progress: Progress, *, overwrite: bool = False
) -> FilmReport:
    """Write the log ``dst`` of a film file, or of a folder of pictures, without poses; it is there once it is complete.

    The world of the log has z up, by how the camera was held, and begins at the first camera, on the floor where one is
    found. Pictures with GPS positions place it instead, unless a scale is given: x is east, y north, z up, in
    metres from the first one's position. Deterministic: the same film, options and machine give the same poses.

    Raises ImportSourceError: no film, no poses can be found, or nothing of what was to tell the scale is found in it.
    ConfigError: a calibration that does not fit. DependencyError: pycolmap is not installed. LogError: ``dst`` is there
    already, or cannot be written.
    """
    colmap.require_colmap()
    film = Film(src, options.quarters)
    lens = _Lens(film, options)
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-film-") as folder:
        return _Import(film, lens, options, Path(folder), on_progress).run(dst, overwrite=overwrite)


class _Lens:
    """What structure from motion sees of a frame: rectified where there is a calibration, else as it is."""

    def __init__(self, film: Film, options: FilmOptions) -> None:
        self.rectify: Rectifier | None = None
        self.measured: CameraIntrinsics | None = None
        self.ratio = film.width / film.full_width  # of what is seen to the film
        self.priors = tuple(f * max(film.width, film.height) for f in FOCAL_PRIORS)
        self.source, self.about = "found, beginning with usual lenses", False
        if film.focal_px is not None:
            self.priors = (film.focal_px, *self.priors)
            self.source, self.about = "found, about that of the picture's EXIF data", True
        if options.focal_prior_px is not None:
            if not 0.1 <= options.focal_prior_px / max(film.full_width, film.full_height) <= 20:
                raise ConfigError(
                    f"--focal-prior {options.focal_prior_px:g}: is no focal length in pixels of pictures of "
                    f"{film.full_width}x{film.full_height}; most lenses have 0.6 to 1.5 times the width"
                )
            self.priors = tuple(f * options.focal_prior_px * self.ratio for f in RETRY_PRIORS)
            self.source, self.about = f"found, beginning with the given {options.focal_prior_px:g}", False
        if options.calibration is None:
            return
        given = rotate_intrinsics(load_calibration(options.calibration), options.quarters)
        if given.width * film.full_height != given.height * film.full_width:
            raise ConfigError(
                f"{options.calibration}: is for images of {given.width}x{given.height}, the film has "
                f"{film.full_width}x{film.full_height}, which is another form; calibrate with a film of the same mode"
            )
        self.source = f"given in {options.calibration.name}"
        self.measured = scale_intrinsics(given, film.width, film.height)
        self.rectify = Rectifier(self.measured)

    def seen(self, bgr: UInt8) -> UInt8:
        """(H, W, 3) BGR as structure from motion sees it."""
        return bgr if self.rectify is None else np.asarray(cv2.cvtColor(self.rectify(bgr), cv2.COLOR_RGB2BGR), np.uint8)

    def request(self, film: Film) -> colmap.Camera:
        """For the process."""
        if self.rectify is None:
            return colmap.Camera(film.width, film.height, None, self.priors, self.about)
        i = self.rectify.intrinsics
        return colmap.Camera(film.width, film.height, (i.fx, i.fy, i.cx + 0.5, i.cy + 0.5), (i.fx,))


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    frames: dict[int, RegisteredFrame]  # by their index in the film
    seen: CameraIntrinsics  # of what was seen, with distortion
    scale: str  # how it was found; empty = unknown
    height_m: float | None  # of the camera over the floor
    floor: str  # at z = 0; empty where it is not, or none is found
    origin: str  # where its origin is on the Earth; empty = not known


class _Import:
    def __init__(self, film: Film, lens: _Lens, options: FilmOptions, folder: Path, on_progress: Progress) -> None:
        self._film, self._lens, self._options, self._folder = film, lens, options, folder
        self._progress = on_progress
        self._notices: list[str] = []
        self._edges: dict[int, Float64] = {}  # of some of the picked frames
        self._board = None if options.scale.board is None else BoardFinder(options.scale.board)
        self._board_seen: list[tuple[int, Float64, Float64]] = []  # frame, corners on the board, in the image
        self._look: FilmLook

    def run(self, dst: Path, *, overwrite: bool) -> FilmReport:
        film = self._film
        self._look = look_through(film, lambda done: self._progress("reading", done, max(done, film.count)))
        if film.unread:
            self._notices.append(
                f"{film.count - film.unread} of the {film.count} frames that the film announces could be read; it is "
                "damaged or cut off: copy or convert it again, if what is missing matters"
            )
        rows = pick_frames(self._look)
        refusals.refuse_look(film.path, self._look, len(rows))
        picked = self._find_features(rows)
        model, error_px = self._map(picked)
        return self._write(dst, picked, self._place(model, picked), error_px, overwrite=overwrite)

    def _find_features(self, rows: Int64) -> list[int]:
        """Index of each picked frame; its features are in the folder, under its place in the sequence."""
        counts: list[int] = []
        picked: list[int] = []
        (self._folder / colmap.FEATURES).mkdir()
        for frame in self._frames({int(i) for i in self._look.index[rows]}):
            seen = self._lens.seen(frame.bgr)
            xy, descriptors = find_features(seen)
            np.savez(self._folder / colmap.FEATURES / f"{len(picked):06d}.npz", xy=xy, descriptors=descriptors)
            if self._board is not None:
                corners = self._board.find(np.asarray(cv2.cvtColor(seen, cv2.COLOR_BGR2RGB), np.uint8))
                self._board_seen += [(frame.index, *corners)] if len(corners[0]) >= MIN_BOARD_CORNERS else []
            if len(picked) % max(1, len(rows) // EDGE_FRAMES) == 0:
                self._edges[frame.index] = find_edges(_gray(seen))
            counts.append(len(xy))
            picked.append(frame.index)
            self._progress("features", len(picked), len(rows))
        refusals.refuse_features(self._film.path, counts)
        return picked

    def _frames(self, wanted: set[int]) -> Iterator[FilmFrame]:
        last = max(wanted, default=-1)
        for frame in self._film:
            if frame.index in wanted:
                yield frame
            if frame.index >= last:
                return

    def _map(self, picked: list[int]) -> tuple[colmap.ColmapModel, float]:
        """The largest model of the best attempt, and its mean reprojection error."""

        def progress(line: str) -> None:
            what, done, total = line.split()
            self._progress(what, int(done), int(total))

        film = self._film
        (self._folder / colmap.REQUEST).write_bytes(msgspec.json.encode(self._lens.request(film)))
        colmap.run_colmap(film.path, [self._folder], progress)
        outcome = msgspec.json.decode((self._folder / colmap.RESULT).read_bytes(), type=colmap.Outcome)
        models = [colmap.read_model(self._folder / model.folder) for model in outcome.best.models]
        spans = [[int(image.name) for image in model.images] for model in models]
        times = [self._seconds(index) for index in picked]
        refusals.refuse_outcome(film.path, outcome, times, spans)
        angle_deg = _parallax_deg(models[0])
        if angle_deg < refusals.LEAST_ANGLE_DEG:
            raise ImportSourceError(f"{film.path}: {refusals.TURNING}")
        self._notices += refusals.baseline_notes(outcome.best.ahead, angle_deg, outcome.focal_sigma)
        if outcome.focal is not None and self._lens.measured is not None:
            given_px = self._lens.measured.fx / self._lens.ratio
            self._notices += refusals.focal_note(film.path, self._options.calibration, given_px, outcome.focal)
        self._notices += [
            f"the part from {times[min(span)]:.1f} to {times[max(span)]:.1f} s ({counted(len(span), 'view')}) "
            "does not hang together with the rest and is left out; import it as a film of its own"
            for span in spans[1:]
            if len(span) >= colmap.MIN_MODEL_IMAGES
        ]
        return models[0], outcome.best.models[0].error_px

    def _place(self, model: colmap.ColmapModel, picked: list[int]) -> _Scene:
        """The model with z up, in metres where that is known, its floor at 0."""
        seen = model.cameras[model.images[0].camera_id]
        frames: dict[int, RegisteredFrame] = {}
        for image in model.images:
            exact = model.errors_px[image.points] < MAX_POINT_ERROR_PX
            xyz = model.xyz[image.points[exact]]
            frames[picked[int(image.name)]] = RegisteredFrame(image.T_world_camera, image.xy[exact], xyz)
        guess = camera_up(np.stack([frame.T_world_camera for frame in frames.values()]))
        up = vertical(self._edges, _poses(frames), seen, guess)
        T_level_world = upright(frames[min(frames)].T_world_camera, guess if up is None else up)
        frames = _moved(frames, T_level_world, UNSCALED_DEPTH_M / median_depth(list(frames.values())))
        floor = _floor(frames, 0.0 if up is not None else FLOOR_CONE_DEG)
        if up is None and floor is not None:
            frames = _moved(frames, upright(frames[min(frames)].T_world_camera, floor.up), 1.0)
            floor = _floor(frames, 0.0) or floor
        if up is None:
            by = "how the camera was held" if floor is None else "square to the floor that was found"
            self._notices.append(f"up is {by}: too few upright edges are seen to tell it better")
        fit = None
        if self._options.scale == ScaleHint():
            try:
                positions = [self._film.position(index) for index in frames]
                fit = place_by_gps(np.stack([frame.T_world_camera for frame in frames.values()]), positions)
            except ImportSourceError as error:
                self._notices.append(f"GPS is not used: {error}")
        if fit is not None:
            T_world_model = fit.T_world_model.copy()
            T_world_model[:3, 3] /= fit.scale
            frames = _moved(frames, T_world_model, fit.scale)
            return _Scene(
                frames, seen, str(fit), None if floor is None else fit.scale * floor.below, "", str(fit.origin)
            )
        try:
            factor, scale = self._scale(frames, seen, floor)
        except ImportSourceError as error:  # the poses are good: `scale` takes a length later
            factor, scale = 1.0, ""
            self._notices.append(f"the scale is unknown: lengths of the log are not metres, since {error}")
        down = np.eye(4)
        if floor is not None:
            down[2, 3] = floor.below - _middle(frames)[2]
        height = None if floor is None else factor * floor.below
        return _Scene(_moved(frames, down, factor), seen, scale, height, describe_floor(floor), "")

    def _scale(
        self, frames: dict[int, RegisteredFrame], seen: CameraIntrinsics, floor: Floor | None
    ) -> tuple[float, str]:
        """Metres per unit, and how they were found; empty = nothing was given. Raises ImportSourceError: not found."""
        hint = self._options.scale
        if hint.factor is not None:
            return hint.factor, f"the stated {hint.factor:g} m per unit"
        if self._board is not None:
            return scale_by_board(self._board_seen, _poses(frames), seen)
        if hint.camera_height_m is not None:
            return scale_by_floor(hint.camera_height_m, 0.0 if floor is None else floor.below, describe_floor(floor))
        self._notices.append(
            "the scale is unknown: lengths of the log are not metres. Give --scale, --camera-height or --square-mm "
            "(with a printed board in the film), or later a known length of the map (`semantic-mapper scale`)"
        )
        return 1.0, ""

    def _write(self, dst: Path, picked: list[int], scene: _Scene, error_px: float, *, overwrite: bool) -> FilmReport:
        film, look = self._film, self._look
        try:
            rectify = self._lens.rectify or Rectifier(scene.seen)
        except ConfigError as error:
            raise ImportSourceError(f"{film.path}: the lens that was found cannot be undone: {error}") from error
        metadata = {
            "poses": "structure from motion",
            SCALE_KEY: scene.scale or SCALE_UNKNOWN,
            **scene_depth(median_depth(list(scene.frames.values()))),
            "stamps": "time within the film",
            **({ORIGIN_KEY: scene.origin} if scene.origin else {}),
            **({FLOOR_KEY: scene.floor} if scene.floor else {}),
        }
        cameras = {CAMERA_ID: rectify.intrinsics}
        info = StreamInfo(f"film {film.path.resolve().name}", cameras, frame_hz=film.hz, metadata=metadata)
        poses: list[Float64] = []
        reasons: list[tuple[str, float]] = []  # why each frame is left out, empty where it is not; and its time
        focal_px = scene.seen.fx / self._lens.ratio
        with atomic_log(dst, info, options=PACKING, overwrite=overwrite) as writer:
            for row, (frame, pose, reason) in enumerate(self._posed(set(picked), scene)):
                self._progress("writing", row + 1, len(look.index))
                if pose is not None:
                    rgb = rectify(frame.bgr)
                    at = frame.stamp_ns, frame.index, CAMERA_ID
                    try:
                        writer.write_frame(PosedFrame(*at, rgb, None, None, rectify.intrinsics, pose, "sfm"))
                    except FrameError as error:
                        reason = str(error)
                    else:
                        poses.append(pose)
                reasons.append((reason, frame.stamp_ns / 1e9))
            counts = dict(Counter(reason for reason, _ in reasons if reason))
            note = FilmNote(len(look.index), counts, len(picked), len(scene.frames), error_px, focal_px)
            writer.attach(note.attachment())
        self._notices += [f"{file.name} {reason}; it is left out" for file, reason in film.odd_pictures.items()]
        points = np.unique(np.concatenate([frame.xyz for frame in scene.frames.values()]), axis=0)
        runs = [(reason, [s for _, s in run]) for reason, run in groupby(reasons, key=lambda item: item[0])]
        return FilmReport(
            note,
            tuple(f"{s[0]:.2f} to {s[-1]:.2f} s: {reason}" for reason, s in runs if reason),
            len(points),
            self._lens.source,
            (self._lens.measured or scene.seen).distortion,
            scene.scale,
            scene.height_m,
            np.stack(poses),
            tuple(self._notices),
        )

    def _posed(self, picked: set[int], scene: _Scene) -> Iterator[tuple[FilmFrame, Float64 | None, str]]:
        """All frames of the film, with T_world_camera (4, 4) of those of the log, or why they are left out."""
        look, ways, blurred = self._look, self._look.way.tolist(), self._look.blurred
        fill = max(FILL, ways[-1] / MAX_FRAMES)
        anchor: tuple[UInt8, RegisteredFrame, float] | None = None  # the last registered frame, and how far the way was
        last_way, last_ns = -np.inf, -(1 << 62)
        for row, (frame, way) in enumerate(zip(self._film, ways, strict=True)):
            registered = scene.frames.get(frame.index)
            moved, since_ns = way - last_way, frame.stamp_ns - last_ns
            wanted = moved >= fill or (since_ns >= FILL_NS and moved >= FILL_LEAST)
            pose, reason = None, ""
            if registered is not None:
                anchor = _gray(self._lens.seen(frame.bgr)), registered, way
                pose = registered.T_world_camera
            elif look.dark[row]:
                reason = "shows nothing"
            elif blurred[row]:
                reason = "blurred"
            elif not wanted and frame.index not in picked:
                reason = "moved too little"
            else:
                if anchor is not None and way - anchor[2] <= FOLLOWED:
                    pose = follow_pose(*anchor[:2], _gray(self._lens.seen(frame.bgr)), scene.seen)
                reason = "its place was not found" if pose is None else ""
            if pose is not None:
                last_way, last_ns = way, frame.stamp_ns
            yield frame, pose, reason

    def _seconds(self, index: int) -> float:
        return float(self._look.stamp_ns[np.searchsorted(self._look.index, index)]) / 1e9


def _poses(frames: dict[int, RegisteredFrame]) -> dict[int, Float64]:
    return {index: frame.T_world_camera for index, frame in frames.items()}


def _moved(frames: dict[int, RegisteredFrame], T: Float64, scale: float) -> dict[int, RegisteredFrame]:
    """The frames after a rigid motion, then a change of scale."""
    result: dict[int, RegisteredFrame] = {}
    for index, frame in frames.items():
        pose = T @ frame.T_world_camera
        pose[:3, 3] *= scale
        result[index] = RegisteredFrame(pose, frame.xy, scale * transform(T, frame.xyz))
    return result


def _floor(frames: dict[int, RegisteredFrame], cone_deg: float) -> Floor | None:
    """The floor under the cameras, where z is up, or up to ``cone_deg`` off it; by points that three frames see."""
    xyz, seen = np.unique(np.concatenate([frame.xyz for frame in frames.values()]), axis=0, return_counts=True)
    return find_floor(xyz[seen >= 3], _middle(frames), np.array((0.0, 0.0, 1.0)), cone_deg)


def _middle(frames: dict[int, RegisteredFrame]) -> Float64:
    """The median (3,) of the positions."""
    return np.median([frame.T_world_camera[:3, 3] for frame in frames.values()], axis=0)


def _parallax_deg(model: colmap.ColmapModel) -> float:
    """Median over the points of the largest angle between two of the rays that they are seen by."""
    centers: dict[int, list[Float64]] = {}
    for image in model.images:
        for point in image.points.tolist():
            centers.setdefault(point, []).append(image.T_world_camera[:3, 3])
    angles: list[float] = []
    for point in sorted(centers)[:: max(1, len(centers) // 2000)]:
        rays = model.xyz[point] - np.stack(centers[point])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))))
    return float(np.median(angles)) if angles else 0.0


def _gray(bgr: UInt8) -> UInt8:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)
