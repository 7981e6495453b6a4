"""A film becomes a log: frames chosen, poses found, scale and up found, and what lies between filled in."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import msgspec
import numpy as np

from semantic_mapper.bundle.scale import floor_height
from semantic_mapper.drivers.calibration import Rectifier, load_calibration
from semantic_mapper.errors import ConfigError, DependencyError, FrameError, ImportSourceError
from semantic_mapper.evaluation.upright import camera_up
from semantic_mapper.geometry import camera_matrix, scale_intrinsics, transform
from semantic_mapper.imaging import rotate_intrinsics
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.format import LogWriter, atomic_log
from semantic_mapper.replay.sfm import colmap_process as colmap
from semantic_mapper.replay.sfm.between import Anchor, follow_pose
from semantic_mapper.replay.sfm.colmap_model import ColmapModel, read_model
from semantic_mapper.replay.sfm.features import find_features
from semantic_mapper.replay.sfm.film import (
    LEAST_MOTION,
    STEP,
    Film,
    FilmFrame,
    FilmLook,
    FilmNote,
    look_through,
    pick_frames,
)
from semantic_mapper.replay.sfm.gps import ORIGIN_KEY, GpsFit, place_by_gps
from semantic_mapper.replay.sfm.refusals import (
    LEAST_ANGLE_DEG,
    TURNING,
    baseline_notes,
    focal_note,
    refuse_features,
    refuse_look,
    refuse_outcome,
)
from semantic_mapper.replay.sfm.scale import (
    NEIGHBOURS,
    UNSCALED_DEPTH_M,
    BoardScale,
    Mark,
    RegisteredFrame,
    ScaleHint,
    find_edges,
    marked_place,
    median_depth,
    nearest_frame,
    scene_depth,
    upright,
    vertical,
)
from semantic_mapper.transport.images import CodecOptions
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import CameraIntrinsics, FisheyeIntrinsics, Float64, Int64, PosedFrame, UInt8

FOCAL_PRIORS = (0.85, 1.2, 0.65)  # of the longer side, in the order of trial: phones, webcams, wide lenses
RETRY_PRIORS = (1.0, 0.85, 1.2)  # of the focal length that was given as a guess
FILL = 0.02  # motion between two frames of the log, of the image's width
FILL_NS, FILL_LEAST = 140_000_000, LEAST_MOTION  # ... or this long after the last one, with this much motion
MAX_FRAMES = 3000  # in a log; longer ways get longer steps
FOLLOWED = 2.5 * STEP  # motion since the last registered frame within which a frame is followed
MAX_POINT_ERROR_PX = 2.0  # points that are less exact are no guide
EDGE_FRAMES = 60  # about as many are searched for upright edges
MAX_POINTS = 20_000  # that the report shows
PACKING = CodecOptions(rgb="jpeg", jpeg_quality=95)  # a film has lost more already

CAMERA_ID = "camera"  # in the log

Progress = Callable[[str, int, int], None]  # what is done; how much of it; of how much


@dataclass(frozen=True, slots=True)
class FilmOptions:
    """How to read a film."""

    calibration: Path | None = None  # file of the camera's calibration; None = focal length and distortion are found
    focal_prior_px: float | None = None  # about the focal length, in pixels of the film; None = guessed, or by EXIF
    scale: ScaleHint = field(default_factory=ScaleHint)  # what tells the size of the scene
    quarters: int = 0  # turn every frame clockwise by this many quarters


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Frames one after the other that are not in the log."""

    reason: str
    start_s: float  # time of the first
    end_s: float  # and of the last
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class FilmReport:
    """What became of a film."""

    film: Path  # its file or folder
    looked_at: int  # frames of the film
    # picked, registered: Frames that structure from motion was given, and has registered.
    picked: int
    registered: int
    left_out: tuple[LeftOut, ...]  # frames that are not in the log, in order
    error_px: float  # mean reprojection error of the points
    points: int  # how many there are
    focal_px: float  # of the frames before they are rectified, in pixels of the film
    focal_source: str  # where it comes from
    distortion: tuple[float, ...]  # OpenCV's coefficients
    scale: str  # how the scale was found; empty = unknown
    height_m: float | None  # median height of the camera over the floor; None where no floor is found
    T_world_camera: Float64  # (N, 4, 4) of the N frames in the log
    xyz: Float64  # (M, 3) points, some of them
    notices: tuple[str, ...]  # sentences on what had to be assumed
    pictures: tuple[tuple[float, UInt8], ...]  # RGB of a few frames of the log, with their times in seconds
    info: StreamInfo  # what stands in the log's head
    bytes: int  # size of the log

    @property
    def frames(self) -> int:
        """In the log."""
        return len(self.T_world_camera)

    @property
    def path_m(self) -> float:
        """Length of the way; in the log's own unit where the scale is unknown."""
        return float(np.linalg.norm(np.diff(self.T_world_camera[:, :3, 3], axis=0), axis=1).sum())

    @property
    def left_out_counts(self) -> dict[str, int]:
        """Frames that are not in the log, by reason."""
        return _counts(self.left_out)


def _counts(left_out: Iterable[LeftOut]) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for part in left_out:
        counts[part.reason] += part.frames
    return dict(counts)


def import_film(
    src: Path, dst: Path, options: FilmOptions, on_progress: Progress, *, overwrite: bool = False
) -> FilmReport:
    """Write the log ``dst`` of a film, or of a folder of pictures, without poses; it is there once it is complete.

    The world of the log has z up, by how the camera was held, and begins at the first camera, on the floor where one is
    found. Pictures with GPS positions place it instead, unless a scale is given: x is east, y north, z up, in
    metres from the first one's position. Deterministic: the same film, options and machine give the same poses.

    Args:
        src: Film file, or folder of pictures.
        dst: Log to write.
        options: How to read.
        on_progress: Called with what is done, how much of it, and of how much.
        overwrite: Whether a log that is there may be replaced.

    Raises:
        ImportSourceError: no film, no poses can be found, or nothing of what was to tell the scale is found in it.
        ConfigError: a calibration that does not fit.
        DependencyError: pycolmap is not installed.
        LogError: ``dst`` is there already, or cannot be written.
    """
    if find_spec("pycolmap") is None:
        raise DependencyError(
            "poses of films are found by pycolmap, which is not installed: pip install 'semantic-mapper[sfm]' (it has "
            "no packages for Linux on ARM: import the film on another machine, and copy the log)"
        )
    film = Film(src, options.quarters)
    lens = _Lens(film, options)
    with tempfile.TemporaryDirectory(prefix="semantic-mapper-film-") as folder:
        return _Import(film, lens, options, Path(folder), on_progress).run(dst, overwrite=overwrite)


class _Lens:
    """What structure from motion sees of a frame: rectified where there is a calibration, else as it is."""

    def __init__(self, film: Film, options: FilmOptions) -> None:
        self.rectify: Rectifier | None = None
        self.measured: CameraIntrinsics | None = None
        ratio = film.width / film.full_width
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
            self.priors = tuple(f * options.focal_prior_px * ratio for f in RETRY_PRIORS)
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

    def seen_pixel(self, u: float, v: float) -> tuple[float, float]:
        """A pixel of the film, made smaller, in what is seen."""
        if self.rectify is None or self.measured is None:
            return u, v
        lens = np.array(self.measured.distortion or (0.0,) * 4)
        K = camera_matrix(self.rectify.intrinsics)
        undistort = cv2.fisheye.undistortPoints if isinstance(self.measured, FisheyeIntrinsics) else cv2.undistortPoints
        flat = undistort(np.array([[[u, v]]], np.float64), camera_matrix(self.measured), lens, P=K)
        return float(flat[0, 0, 0]), float(flat[0, 0, 1])

    def request(self, film: Film) -> colmap.Camera:
        """For the process."""
        if self.rectify is None:
            return colmap.Camera(film.width, film.height, None, self.priors, self.about)
        i = self.rectify.intrinsics
        return colmap.Camera(film.width, film.height, (i.fx, i.fy, i.cx + 0.5, i.cy + 0.5), (i.fx,))


@dataclass(frozen=True, slots=True, eq=False)
class _Registered:
    """The frames of the chosen model, by their index in the film, in the world of the log."""

    frames: dict[int, RegisteredFrame]
    xy: dict[int, Float64]  # (N, 2) pixels of the points of each
    seen: CameraIntrinsics  # of what was seen, with distortion


class _Import:
    """One import; its steps in order."""

    def __init__(self, film: Film, lens: _Lens, options: FilmOptions, folder: Path, on_progress: Progress) -> None:
        self._film, self._lens, self._options, self._folder = film, lens, options, folder
        self._progress = on_progress
        self._notices: list[str] = []
        self._edges: dict[int, Float64] = {}  # of some of the picked frames
        self._gps: GpsFit | None = None

    def run(self, dst: Path, *, overwrite: bool) -> FilmReport:
        film = self._film
        look = look_through(film, lambda done: self._progress("look", done, max(done, film.count)))
        if film.unread:
            self._notices.append(
                f"{film.count - film.unread} of the {film.count} frames that the film announces could be read; it is "
                "damaged or cut off: copy or convert it again, if what is missing matters"
            )
        rows = pick_frames(look)
        refuse_look(film.path, look, len(rows))
        if self._options.scale.distance is not None:
            for mark in (self._options.scale.distance.a, self._options.scale.distance.b):
                self._check_mark(mark, look)
        board = None if self._options.scale.board is None else BoardScale(self._options.scale.board)
        picked = self._find_features(look, rows, board)
        outcome = self._run_colmap()
        models, error_px = self._judge(outcome, look, picked)
        registered, scale, height = self._orient(models, look, picked, board)
        return self._write(dst, look, picked, registered, scale, height, error_px, overwrite=overwrite)

    def _find_features(self, look: FilmLook, rows: Int64, board: BoardScale | None) -> list[int]:
        """Index of each picked frame; its features are in the folder, under its place in the sequence."""
        counts: list[int] = []
        picked: list[int] = []
        (self._folder / colmap.FEATURES).mkdir()
        for frame in self._frames({int(i) for i in look.index[rows]}):
            seen = self._lens.seen(frame.bgr)
            xy, descriptors = find_features(seen)
            np.savez(self._folder / colmap.FEATURES / f"{len(picked):06d}.npz", xy=xy, descriptors=descriptors)
            if board is not None:
                board.look(frame.index, np.asarray(cv2.cvtColor(seen, cv2.COLOR_BGR2RGB), np.uint8))
            if len(picked) % max(1, len(rows) // EDGE_FRAMES) == 0:
                self._edges[frame.index] = find_edges(_gray(seen))
            counts.append(len(xy))
            picked.append(frame.index)
            self._progress("features", len(picked), len(rows))
        refuse_features(self._film.path, counts)
        return picked

    def _frames(self, wanted: set[int]) -> Iterator[FilmFrame]:
        last = max(wanted, default=-1)
        for frame in self._film:
            if frame.index in wanted:
                yield frame
            if frame.index >= last:
                return

    def _run_colmap(self) -> colmap.Outcome:
        request = self._lens.request(self._film)
        (self._folder / colmap.REQUEST).write_bytes(msgspec.json.encode(request))
        errors = self._folder / "stderr.txt"
        command = [sys.executable, "-I", "-m", colmap.__name__, str(self._folder)]
        with errors.open("wb") as stderr:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr)
            try:
                assert process.stdout is not None
                for line in process.stdout:
                    what, done, total = line.decode().split()
                    self._progress(what, int(done), int(total))
                code = process.wait()
            finally:
                process.kill()  # after Ctrl-C; one that has ended does not mind
                process.wait()
                if process.stdout is not None:
                    process.stdout.close()
        if code:
            said = errors.read_text("utf-8", "replace").strip().splitlines()
            raise ImportSourceError(
                f"{self._film.path}: pycolmap ended with exit code {code}: {said[-1] if said else 'it said nothing'}"
            )
        return msgspec.json.decode((self._folder / colmap.RESULT).read_bytes(), type=colmap.Outcome)

    def _judge(self, outcome: colmap.Outcome, look: FilmLook, picked: list[int]) -> tuple[list[ColmapModel], float]:
        """Models of the best attempt, the largest first, and the mean reprojection error of that one.

        Raises:
            ImportSourceError: see ``refuse_outcome``.
        """
        film, best = self._film, outcome.attempts[colmap.best_attempt(outcome.attempts)]
        models = [read_model(self._folder / model.folder) for model in best.models]
        spans = [[int(image.name) for image in model.images] for model in models]
        times = [_seconds(look, index) for index in picked]
        refuse_outcome(film.path, outcome, times, spans)
        angle_deg = _parallax_deg(models[0])
        if angle_deg < LEAST_ANGLE_DEG:
            raise ImportSourceError(f"{film.path}: {TURNING}")
        self._notices += baseline_notes(best.ahead, angle_deg, outcome.focal_sigma)
        if outcome.focal is not None and self._lens.measured is not None:
            given_px = self._lens.measured.fx * film.full_width / film.width
            self._notices += focal_note(film.path, self._options.calibration, given_px, outcome.focal)
        for span in spans[1:]:
            if len(span) >= colmap.MIN_MODEL_IMAGES:
                self._notices.append(
                    f"the part from {times[min(span)]:.1f} to {times[max(span)]:.1f} s ({counted(len(span), 'view')}) "
                    "does not hang together with the rest and is left out; import it as a film of its own"
                )
        return models, best.models[0].error_px

    def _orient(
        self, models: list[ColmapModel], look: FilmLook, picked: list[int], board: BoardScale | None
    ) -> tuple[_Registered, str, float | None]:
        """The largest model with z up, in metres, its floor at 0; how its scale was found; the camera's height."""
        model = models[0]
        seen = model.cameras[model.images[0].camera_id]
        frames: dict[int, RegisteredFrame] = {}
        xy: dict[int, Float64] = {}
        for image in model.images:
            index = picked[int(image.name)]
            errors_px = np.array([model.errors_px.get(int(p), np.inf) for p in image.point_ids])
            good = errors_px < MAX_POINT_ERROR_PX
            xyz = np.array([model.points[int(p)] for p in image.point_ids[good]]).reshape(-1, 3)
            xy[index] = image.xy[good]
            frames[index] = RegisteredFrame(image.T_world_camera, xyz)
        poses = {index: frame.T_world_camera for index, frame in frames.items()}
        guess = camera_up(np.stack(list(poses.values())))
        up = vertical(self._edges, poses, seen, guess)
        if up is None:
            self._notices.append("up is how the camera was held: too few upright edges are seen to tell it better")
        frames = _moved(frames, upright(frames[min(frames)].T_world_camera, guess if up is None else up), 1.0)
        frames = _moved(frames, np.eye(4), UNSCALED_DEPTH_M / median_depth(list(frames.values())))
        self._gps = self._place_by_gps(frames)
        if self._gps is not None:
            fit, scale = self._gps, str(self._gps)
            T_world_model = fit.T_world_model.copy()
            T_world_model[:3, 3] /= fit.scale
            frames = _moved(frames, T_world_model, fit.scale)
        else:
            factor, scale = self._scale(_Registered(frames, xy, seen), look, board)
            frames = _moved(frames, np.eye(4), factor)
        floor, height = _floor_and_height(frames)
        if floor is not None and self._gps is None:
            down = np.eye(4)
            down[2, 3] = -floor
            frames = _moved(frames, down, 1.0)
        return _Registered(frames, xy, seen), scale, height

    def _place_by_gps(self, frames: dict[int, RegisteredFrame]) -> GpsFit | None:
        """Where the pictures' positions put the model, unless a scale is given; None = they do not say."""
        if self._options.scale != ScaleHint():
            return None
        try:
            return place_by_gps(
                np.stack([frame.T_world_camera for frame in frames.values()]),
                [self._film.position(index) for index in frames],
            )
        except ImportSourceError as error:
            self._notices.append(f"GPS is not used: {error}")
            return None

    def _scale(self, registered: _Registered, look: FilmLook, board: BoardScale | None) -> tuple[float, str]:
        """Metres per unit, and how they were found; empty = they were not."""
        hint, frames = self._options.scale, registered.frames
        if hint.factor is not None:
            return hint.factor, f"given: {hint.factor:g} m per unit"
        if board is not None:
            return board.metres_per_unit({i: f.T_world_camera for i, f in frames.items()}, registered.seen)
        if hint.camera_height_m is not None:
            _, height = _floor_and_height(frames)
            if height is None:
                raise ImportSourceError(
                    f"{self._film.path}: no floor is found under the camera, so its height tells no scale; film more "
                    "of the floor, or give the scale in another way"
                )
            return hint.camera_height_m / height, f"camera {hint.camera_height_m:g} m over the floor that was found"
        if hint.distance is not None:
            a, b = (self._marked_place(mark, registered, look) for mark in (hint.distance.a, hint.distance.b))
            found = float(np.linalg.norm(a - b))
            if found < 1e-6:
                raise ImportSourceError("the two marked points are one; mark two that are far apart")
            return hint.distance.metres / found, f"two marked points, {hint.distance.metres:g} m apart"
        self._notices.append(
            "the scale is unknown: lengths of the log are not metres. Give one of --scale, --distance, --square-mm "
            "(with a printed board in the film) or --camera-height"
        )
        return 1.0, ""

    def _check_mark(self, mark: Mark, look: FilmLook) -> None:
        """Refuse a mark outside of the film, before the long work begins."""
        film, last_s = self._film, look.stamp_ns[-1] / 1e9
        if mark.time_s > last_s + 0.5 / film.hz:
            raise ImportSourceError(
                f"{film.path}: --distance marks a point at {mark.time_s:g} s, and the last frame is at {last_s:.2f} s; "
                "give times within the film"
            )
        if not (0 <= mark.u < film.full_width and 0 <= mark.v < film.full_height):
            raise ImportSourceError(
                f"{film.path}: --distance marks the pixel {mark.u:g},{mark.v:g}, outside of the film's "
                f"{film.full_width}x{film.full_height}"
            )

    def _marked_place(self, mark: Mark, registered: _Registered, look: FilmLook) -> Float64:
        ratio = self._film.width / self._film.full_width
        seen = Mark(mark.time_s, *self._lens.seen_pixel(mark.u * ratio, mark.v * ratio))
        row = nearest_frame(mark.time_s, look.stamp_ns)
        way = look.way
        order = sorted(registered.frames)
        rows = np.searchsorted(look.index, order)
        near = [_seconds(look, order[n]) for n in np.argsort(np.abs(rows - row), kind="stable")[:4]]
        if np.abs(way[rows] - way[row]).min() > FOLLOWED:
            raise ImportSourceError(
                f"{self._film.path}: --distance marks a point at {mark.time_s:g} s, where the camera's place was not "
                f"found; mark it at another time, such as {', '.join(f'{s:.2f}' for s in sorted(near))} s"
            )
        at = int(np.searchsorted(rows, row))
        marked = int(look.index[row])
        chosen = {marked, *order[max(0, at - NEIGHBOURS) : at + NEIGHBOURS + 1]}
        pictures = {f.index: _gray(self._lens.seen(f.bgr)) for f in self._frames(chosen)}
        poses = {index: frame.T_world_camera for index, frame in registered.frames.items()}
        return marked_place(seen, marked, pictures, poses, registered.seen)

    def _write(
        self,
        dst: Path,
        look: FilmLook,
        picked: list[int],
        registered: _Registered,
        scale: str,
        height_m: float | None,
        error_px: float,
        *,
        overwrite: bool,
    ) -> FilmReport:
        film = self._film
        try:
            rectify = self._lens.rectify or Rectifier(registered.seen)
        except ConfigError as error:
            raise ImportSourceError(f"{film.path}: the lens that was found cannot be undone: {error}") from error
        chooser = _Chooser(look, set(picked), registered)
        info = StreamInfo(
            source=f"film {film.path.resolve().name}",
            cameras={CAMERA_ID: rectify.intrinsics},
            frame_hz=film.hz,
            metadata={
                "poses": "structure from motion",
                SCALE_KEY: scale or SCALE_UNKNOWN,
                **scene_depth(median_depth(list(registered.frames.values()))),
                "stamps": "time within the film",
            }
            | ({} if self._gps is None else {ORIGIN_KEY: str(self._gps.origin)}),
        )
        poses: list[Float64] = []
        left_out: list[LeftOut] = []
        pictures: list[tuple[float, UInt8]] = []
        focal_px = registered.seen.fx * film.full_width / film.width
        shown = set(np.linspace(0, len(look.index) - 1, 14).astype(int)[1:-1].tolist())
        with atomic_log(dst, info, options=PACKING, overwrite=overwrite) as writer:
            last = ""
            for row, frame in enumerate(film):
                self._progress("write", row + 1, len(look.index))
                seconds = frame.stamp_ns / 1e9
                pose, reason = chooser.pose(row, frame, self._lens)
                if pose is not None:
                    rgb = rectify(frame.bgr)
                    reason = _written(writer, frame, rgb, rectify.intrinsics, pose)
                    if not reason:
                        poses.append(pose)
                        if shown and row >= min(shown):
                            shown = {s for s in shown if s > row}
                            pictures.append((seconds, rgb))
                if reason and reason == last:
                    left_out[-1] = replace(left_out[-1], end_s=seconds, frames=left_out[-1].frames + 1)
                elif reason:
                    left_out.append(LeftOut(reason, seconds, seconds, 1))
                last = reason
            note = FilmNote(len(look.index), _counts(left_out), len(picked), len(registered.frames), error_px, focal_px)
            writer.attach(note.attachment())
        self._notices += [f"{file.name} {reason}; it is left out" for file, reason in film.odd_pictures.items()]
        xyz = np.unique(np.concatenate([frame.xyz for frame in registered.frames.values()]), axis=0)
        return FilmReport(
            film=film.path,
            looked_at=len(look.index),
            picked=len(picked),
            registered=len(registered.frames),
            left_out=tuple(left_out),
            error_px=error_px,
            points=len(xyz),
            focal_px=focal_px,
            focal_source=self._lens.source,
            distortion=(self._lens.measured or registered.seen).distortion,
            scale=scale,
            height_m=height_m,
            T_world_camera=np.stack(poses),
            xyz=xyz[np.random.default_rng(0).permutation(len(xyz))[:MAX_POINTS]],
            notices=tuple(self._notices),
            pictures=tuple(pictures),
            info=info,
            bytes=dst.stat().st_size,
        )


def _written(writer: LogWriter, frame: FilmFrame, rgb: UInt8, intrinsics: CameraIntrinsics, pose: Float64) -> str:
    """Write a frame; why it cannot be written, else empty."""
    try:
        writer.write_frame(
            PosedFrame(
                stamp_ns=frame.stamp_ns,
                seq=frame.index,
                camera_id=CAMERA_ID,
                rgb=rgb,
                depth_m=None,
                label=None,
                intrinsics=intrinsics,
                T_world_camera=pose,
                pose_source="sfm",
            )
        )
    except FrameError as error:
        return str(error)
    return ""


class _Chooser:
    """Which frames come into the log, and with which pose; frames come in order."""

    def __init__(self, look: FilmLook, picked: set[int], registered: _Registered) -> None:
        self._look, self._picked, self._registered = look, picked, registered
        self._way, self._blurred = look.way, look.blurred
        self._fill = max(FILL, float(self._way[-1]) / MAX_FRAMES)
        self._anchor: Anchor | None = None
        self._anchor_way = self._last_way = -np.inf
        self._last_ns = -(1 << 62)

    def pose(self, row: int, frame: FilmFrame, lens: _Lens) -> tuple[Float64 | None, str]:
        """T_world_camera (4, 4) of a frame of the log; or None and why it is left out."""
        way = float(self._way[row])
        registered = self._registered.frames.get(frame.index)
        if registered is not None:
            self._anchor = Anchor(
                _gray(lens.seen(frame.bgr)), self._registered.xy[frame.index], registered.xyz, registered.T_world_camera
            )
            self._anchor_way = way
            return self._taken(registered.T_world_camera, way, frame.stamp_ns), ""
        if self._look.dark[row]:
            return None, "shows nothing"
        if self._blurred[row]:
            return None, "blurred"
        moved, since_ns = way - self._last_way, frame.stamp_ns - self._last_ns
        wanted = moved >= self._fill or (since_ns >= FILL_NS and moved >= FILL_LEAST)
        if not wanted and frame.index not in self._picked:
            return None, "moved too little"
        if self._anchor is None or way - self._anchor_way > FOLLOWED:
            return None, "its place was not found"
        pose = follow_pose(self._anchor, _gray(lens.seen(frame.bgr)), self._registered.seen)
        if pose is None:
            return None, "its place was not found"
        return self._taken(pose, way, frame.stamp_ns), ""

    def _taken(self, pose: Float64, way: float, stamp_ns: int) -> Float64:
        self._last_way, self._last_ns = way, stamp_ns
        return pose


def _moved(frames: dict[int, RegisteredFrame], T: Float64, scale: float) -> dict[int, RegisteredFrame]:
    """The frames after a rigid motion, then a change of scale."""
    result: dict[int, RegisteredFrame] = {}
    for index, frame in frames.items():
        pose = T @ frame.T_world_camera
        pose[:3, 3] *= scale
        result[index] = RegisteredFrame(pose, scale * transform(T, frame.xyz))
    return result


def _floor_and_height(frames: dict[int, RegisteredFrame]) -> tuple[float | None, float | None]:
    """z of the floor, where z is up, and the camera's median height over it; None if no floor is found."""
    camera_z = float(np.median([frame.T_world_camera[2, 3] for frame in frames.values()]))
    floor = floor_height(np.concatenate([frame.xyz[:, 2] for frame in frames.values()]), camera_z)
    return floor, None if floor is None else camera_z - floor


def _parallax_deg(model: ColmapModel) -> float:
    """Median over the points of the largest angle between two of the rays that they are seen by."""
    centers: dict[int, list[Float64]] = {}
    for image in model.images:
        for point in image.point_ids[image.point_ids >= 0].tolist():
            centers.setdefault(point, []).append(image.T_world_camera[:3, 3])
    angles: list[float] = []
    for point in sorted(centers)[:: max(1, len(centers) // 2000)]:
        rays = model.points[point] - np.stack(centers[point])
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))))
    return float(np.median(angles)) if angles else 0.0


def _gray(bgr: UInt8) -> UInt8:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), np.uint8)


def _seconds(look: FilmLook, index: int) -> float:
    return float(look.stamp_ns[np.searchsorted(look.index, index)]) / 1e9
