"""The process in which pycolmap runs: a crash of its native code, or Ctrl-C, ends this process alone.

``python -m semantic_mapper.replay.sfm.colmap_process FOLDER`` reads ``request.json`` and ``features/NNNNNN.npz`` from
the folder, and writes a folder ``attempt-K/M`` for each model M of each attempt K, and ``result.json``. Each line on
stdout is progress: "what done total".
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.replay.sfm.features import loop_pairs, match_features
from semantic_mapper.types import Bool, Float64, UInt8

REQUEST, RESULT, DATABASE, FEATURES = "request.json", "result.json", "database.db", "features"
OVERLAP = 8  # frames before each that it is matched to
PAIRS_AT_ONCE = 64
ENOUGH = 0.9  # of the frames in one model: no further focal length is tried
LEAST_FREE = 0.5  # of the frames, registered with a free focal length: it is not tried held
SEED = 1  # pycolmap takes 0 for "another each time"
MIN_MODEL_IMAGES = 5
INIT_TRIALS = 40
LARGE, LEAST_PRECISION = 1280, 0.25  # pixels of the longer side from which on COLMAP's limits hold; their least factor
MAX_FOCAL_CHANGE = 0.1  # of one that is known about: EXIF data has whole millimetres, and the picture may be cropped
FOCAL_RANGE = 0.2, 5.0  # times the longer side; a model beyond it has run away
LINK_MATCHES = 20  # of two frames that show one place
FLAT = 0.93  # of the matches that one homography explains: nothing but a turn, or one plane
TURNED = 0.8  # of the matches that a turn explains: nothing but that
TURN_PX, TURN_FOCALS = 3.0, np.geomspace(0.4, 2.0, 12)  # off a turn at most, for 640 pixels; of the longer side
# Where a first attempt fails: two frames to begin with may lie straight ahead of each other, and the median angle
# between the rays to what both see may be this small. COLMAP's defaults, 0.95 and 16 degrees, leave none to a camera
# that goes forwards. It begins with the widest, and halves the angle twice.
AHEAD_MAX_FORWARD, AHEAD_ANGLE_DEG = 1.0, 8.0
UNKNOWN_FOCAL = 0.3  # standard deviation of a focal length that usual lenses tell better than the film: it is assumed


class Camera(msgspec.Struct, frozen=True):
    """The camera of all frames, in COLMAP's convention: the first pixel's centre is at 0.5."""

    width: int
    height: int
    fixed: tuple[float, float, float, float] | None  # fx, fy, cx, cy of a calibrated camera, which stay
    focal_priors: tuple[float, ...]  # to begin with, in this order, until most frames find their place
    # The first of these is known about, and held until all frames have their place: rows of pictures over flat ground
    # fit a wrong one as well.
    about: bool = False


class Model(msgspec.Struct, frozen=True):
    """One model that an attempt has given."""

    folder: str  # with COLMAP's binary files
    images: int  # registered
    error_px: float  # mean reprojection error
    focal_px: float  # found or given


class Attempt(msgspec.Struct, frozen=True):
    """What came of one focal length."""

    focal_prior_px: float  # to begin with
    models: list[Model]  # the largest first
    ahead: bool = False  # begun with two frames that may lie straight ahead of each other


class Pair(msgspec.Struct, frozen=True):
    """Two frames, by their places in the sequence, with matches that agree with one geometry."""

    first: int
    second: int
    matches: int
    flat: float  # fraction that one homography explains: 1 for a camera that only turns, or one plane
    turn: float = 0.0  # fraction that a turn on the spot explains


class FocalCheck(msgspec.Struct, frozen=True):
    """What the pictures say of a given focal length."""

    factor: float  # by which it has to be multiplied to fit them best
    sigmas: float  # how sure that is: the difference over its own standard deviation


class Outcome(msgspec.Struct, frozen=True):
    """All that the process tells."""

    attempts: list[Attempt]  # in the order of trial
    pairs: list[Pair]  # of frames near each other
    focal: FocalCheck | None = None  # of the largest model of a calibrated camera
    # Standard deviation of a focal length that was found, as a fraction of it: noise of the features alone. Above
    # ``UNKNOWN_FOCAL`` the model has the one that the attempt began with.
    focal_sigma: float | None = None


def best_attempt(attempts: Sequence[Attempt]) -> int:
    """The one with the largest model, of equal ones that with the smallest error."""
    sizes = [(a.models[0].images, -a.models[0].error_px) if a.models else (0, 0.0) for a in attempts]
    return max(range(len(attempts)), key=sizes.__getitem__)


def turn_fraction(pairs: Sequence[Pair]) -> float:
    """Of the pairs some steps apart, those that a turn on the spot explains."""
    apart = _apart(pairs)
    return float(np.mean([p.turn >= TURNED for p in apart])) if apart else 0.0


def only_turns(pairs: Sequence[Pair]) -> bool:
    """Whether half of the pairs some steps apart show nothing but a turn, or one plane."""
    apart = _apart(pairs)
    flat = float(np.mean([p.flat >= FLAT for p in apart])) if apart else 0.0
    return max(flat, turn_fraction(pairs)) >= 0.5


def _apart(pairs: Sequence[Pair]) -> list[Pair]:
    return [p for p in pairs if p.second - p.first >= 2 and p.matches >= LINK_MATCHES]


def main(folder: Path) -> None:
    """Match and map what is in a folder."""
    import pycolmap

    pycolmap.logging.minloglevel = 3  # nothing but what ends the process
    pycolmap.set_random_seed(SEED)
    camera = msgspec.json.decode((folder / REQUEST).read_bytes(), type=Camera)
    files = sorted((folder / FEATURES).glob("*.npz"))
    descriptors = _fill_database(pycolmap, folder / DATABASE, camera, files)
    pairs = [(i, j) for i in range(len(files)) for j in range(i + 1, min(i + OVERLAP + 1, len(files)))]
    pairs += loop_pairs(descriptors, OVERLAP, SEED)
    _match(pycolmap, folder, [file.stem for file in files], descriptors, pairs, _precision(camera))
    verified = _verified(pycolmap, folder / DATABASE, camera)
    attempts = _attempts(pycolmap, folder, camera, len(files), turns=only_turns(verified))
    best = attempts[best_attempt(attempts)]
    focal = focal_sigma = None
    if best.models:
        at = folder / best.models[0].folder
        focal = None if camera.fixed is None else _check_focal(pycolmap, at)
        known = camera.about and best.focal_prior_px == camera.focal_priors[0]
        focal_sigma = _settle(pycolmap, at, camera, best.focal_prior_px, free=camera.fixed is None and not known)
    (folder / RESULT).write_bytes(msgspec.json.encode(Outcome(attempts, verified, focal, focal_sigma)))


def _attempts(pycolmap: Any, folder: Path, camera: Camera, count: int, *, turns: bool) -> list[Attempt]:
    """Until one has registered most frames; a camera that turns on the spot gets none that begins straight ahead.

    Straight ahead, the focal length is tried free. It is held only where that places next to nothing: two frames of a
    way without any turn fit all of them, and a wrong one that is held bends the path.
    """
    attempts: list[Attempt] = []
    for number, prior in enumerate(camera.focal_priors if camera.fixed is None else (camera.fixed[0],)):
        known = camera.about and number == 0
        for ahead, held in dict.fromkeys(((False, known), (True, known), (True, camera.fixed is None))):
            registered = max((a.models[0].images for a in attempts if a.models), default=0)
            if ahead and (turns or (held and not known and registered >= LEAST_FREE * count)):
                continue
            models = _map(pycolmap, folder, len(attempts), camera, prior, count, held=held, ahead=ahead)
            if known:
                models = [_freed(pycolmap, folder, model, prior) for model in models]
            attempts.append(Attempt(prior, models, ahead))
            if models and models[0].images >= ENOUGH * count:
                return attempts
    return attempts


def _fill_database(pycolmap: Any, path: Path, camera: Camera, files: list[Path]) -> list[UInt8]:
    descriptors: list[UInt8] = []
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(_camera(pycolmap, camera, camera.focal_priors[0]))
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
        rig_id = database.write_rig(rig)
        for file in files:
            with np.load(file) as stored:
                xy, rows = stored["xy"], stored["descriptors"]
            image_id = database.write_image(pycolmap.Image(name=file.stem, camera_id=camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), image_id))
            database.write_frame(frame)
            database.write_keypoints(image_id, (xy + 0.5).astype(np.float32))
            descriptors.append(rows)
    return descriptors


def _camera(pycolmap: Any, camera: Camera, prior: float, *, held: bool = False) -> Any:
    if camera.fixed is not None:
        model, params = "PINHOLE", list(camera.fixed)
    else:
        model, params = "SIMPLE_RADIAL", [prior, camera.width / 2, camera.height / 2, 0.0]
    return pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=params,
        has_prior_focal_length=camera.fixed is not None or held,  # else COLMAP begins with one of its own
        camera_id=1,
    )


def _match(
    pycolmap: Any,
    folder: Path,
    names: list[str],
    descriptors: list[UInt8],
    pairs: list[tuple[int, int]],
    precision: float,
) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.ransac.max_error *= precision
    verification.compute_relative_pose = False
    listed = folder / "pairs.txt"
    with pycolmap.Database.open(folder / DATABASE) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for done, (i, j) in enumerate(pairs):
            matches = match_features(descriptors[i], descriptors[j])
            database.write_matches(ids[names[i]], ids[names[j]], matches)
            if done % PAIRS_AT_ONCE == 0:
                _tell("match", done, len(pairs))
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    pycolmap.verify_matches(folder / DATABASE, listed, verification)
    _tell("match", len(pairs), len(pairs))


def _map(
    pycolmap: Any, folder: Path, number: int, camera: Camera, prior: float, count: int, *, held: bool, ahead: bool
) -> list[Model]:
    """Models of one attempt, the largest first.

    Args:
        pycolmap, folder, number, camera, prior, count: What to map, and where.
        held: The focal length stays.
        ahead: The two frames to begin with may lie straight ahead of each other.
    """
    with pycolmap.Database.open(folder / DATABASE) as database:
        database.update_camera(_camera(pycolmap, camera, prior, held=held))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = 1  # several threads add up in another order each time
    options.min_model_size = MIN_MODEL_IMAGES
    options.max_num_models = 6
    options.init_num_trials = INIT_TRIALS
    options.extract_colors = False
    options.ba_refine_extra_params = camera.fixed is None
    options.ba_refine_focal_length = camera.fixed is None and not held
    if ahead:
        options.mapper.init_max_forward_motion = AHEAD_MAX_FORWARD
        options.mapper.init_min_tri_angle = AHEAD_ANGLE_DEG
    precision = _precision(camera)
    options.mapper.init_max_error *= precision
    options.mapper.abs_pose_max_error *= precision
    options.mapper.filter_max_reproj_error *= precision
    options.triangulation.merge_max_reproj_error *= precision
    options.triangulation.complete_max_reproj_error *= precision
    options.mapper.abs_pose_refine_extra_params = camera.fixed is None
    options.mapper.abs_pose_refine_focal_length = camera.fixed is None and not held
    options.min_focal_length_ratio = options.mapper.min_focal_length_ratio = FOCAL_RANGE[0]
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = FOCAL_RANGE[1]
    done = [0]

    def step(images: int) -> None:
        done[0] = min(done[0] + images, count)
        _tell("map", done[0], count)

    out = folder / f"attempt-{number}"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    step(0)
    found = pycolmap.incremental_mapping(
        folder / DATABASE,
        folder,
        out,
        options,
        initial_image_pair_callback=lambda: step(2),
        next_image_callback=lambda: step(1),
    )
    models = [_figures(f"{out.name}/{index}", model) for index, model in found.items()]
    size = max(camera.width, camera.height)
    models = [model for model in models if FOCAL_RANGE[0] < model.focal_px / size < FOCAL_RANGE[1]]
    return sorted(models, key=lambda model: (-model.images, model.error_px))


def _figures(folder: str, model: Any) -> Model:
    return Model(
        folder=folder,
        images=model.num_reg_images(),
        error_px=float(model.compute_mean_reprojection_error()),
        focal_px=float(next(iter(model.cameras.values())).mean_focal_length()),
    )


def _adjustment(pycolmap: Any, **options: bool) -> Any:
    """Options of a bundle adjustment in one thread: several add up in another order each time."""
    found = pycolmap.BundleAdjustmentOptions()
    found.print_summary = False
    found.ceres.solver_options.num_threads = 1
    for name, value in options.items():
        setattr(found, name, value)
    return found


def _freed(pycolmap: Any, folder: Path, held: Model, prior: float) -> Model:
    """A model, adjusted with a free focal length; as it was where that runs away from the known one."""
    model = pycolmap.Reconstruction(folder / held.folder)
    pycolmap.bundle_adjustment(model, _adjustment(pycolmap))
    model.update_point_3d_errors()
    freed = _figures(held.folder, model)
    if abs(freed.focal_px / prior - 1) > MAX_FOCAL_CHANGE:
        return held
    model.write(folder / held.folder)
    return freed


def _check_focal(pycolmap: Any, folder: Path) -> FocalCheck:
    """Adjust a model with its focal length as it is, then with a free one; the model on disk stays as it is.

    What the squared errors lose, over their mean, is the square of the difference in standard deviations.
    """
    model = pycolmap.Reconstruction(folder)
    errors, focal = list[float](), list[float]()
    for free in (False, True):
        options = _adjustment(pycolmap, refine_extra_params=False, refine_focal_length=free)
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()
        errors.append(_squared_px(model))
        focal.append(float(next(iter(model.cameras.values())).mean_focal_length()))
    if errors[1] <= 0:
        return FocalCheck(1.0, 0.0)
    return FocalCheck(focal[1] / focal[0], (max(0.0, errors[0] / errors[1] - 1) * _free_values(model)) ** 0.5)


def _settle(pycolmap: Any, folder: Path, camera: Camera, prior: float, *, free: bool) -> float | None:
    """Adjust the model in a folder until it converges; the standard deviation of a free focal length, as a fraction.

    A covariance belongs to the minimum, and while it maps, COLMAP ends its adjustments before that. A focal length that
    the film does not tell becomes the prior.

    Args:
        pycolmap, folder, camera, prior: What to adjust.
        free: The focal length.
    """
    model = pycolmap.Reconstruction(folder)
    adjuster = _adjust(pycolmap, model, camera, free=free)
    sigma = _focal_sigma(pycolmap, model, camera, adjuster) if free and adjuster is not None else None
    if sigma is not None and sigma > UNKNOWN_FOCAL:
        model = pycolmap.Reconstruction(folder)
        lens = next(iter(model.cameras.values()))
        lens.params = [prior, *lens.params[1:]]
        adjuster = _adjust(pycolmap, model, camera, free=False)
    if adjuster is not None:
        model.write(folder)
    return sigma


def _adjust(pycolmap: Any, model: Any, camera: Camera, *, free: bool) -> Any | None:
    """Adjust a model until it converges, with the first two cameras held; what did it, None if it failed."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = _adjustment(pycolmap, refine_focal_length=free, refine_extra_params=camera.fixed is None)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    usable = adjuster.solve().is_solution_usable()
    model.update_point_3d_errors()
    return adjuster if usable else None


def _focal_sigma(pycolmap: Any, model: Any, camera: Camera, adjuster: Any) -> float | None:
    """Standard deviation of the focal length as a fraction, 1 at most; None = unknown."""
    lens = next(iter(model.cameras.values()))
    focal = float(lens.mean_focal_length())
    if not FOCAL_RANGE[0] < focal / max(camera.width, camera.height) < FOCAL_RANGE[1]:
        return 1.0
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    of_lens = None if covariance is None else covariance.get_other_params_cov(lens.params)
    if of_lens is None:
        return None
    noise_px = np.sqrt(_squared_px(model) / max(1, _free_values(model)))  # of one coordinate of a feature
    return min(1.0, float(noise_px * np.sqrt(of_lens[0, 0])) / focal)


def _squared_px(model: Any) -> float:
    """Sum of the squared residuals."""
    return sum(point.track.length() * point.error**2 for point in model.points3D.values())


def _free_values(model: Any) -> int:
    """Measurements beyond those that make the model."""
    seen = sum(point.track.length() for point in model.points3D.values())
    return max(0, 2 * seen - 6 * model.num_reg_images() - 3 * len(model.points3D))


def _precision(camera: Camera) -> float:
    """Factor of COLMAP's limits in pixels, which are for large photographs."""
    return min(1.0, max(LEAST_PRECISION, max(camera.width, camera.height) / LARGE))


def _verified(pycolmap: Any, path: Path, camera: Camera) -> list[Pair]:
    """Pairs of frames near each other in the sequence, whose matches agree."""
    size = max(camera.width, camera.height)
    centre = np.array(((camera.width, camera.height), (camera.width, camera.height))) / 2
    focals = TURN_FOCALS * size if camera.fixed is None else np.array(camera.fixed[:1])
    if camera.fixed is not None:
        centre[:] = camera.fixed[2:]
    pairs: list[Pair] = []
    with pycolmap.Database.open(path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        for i, first in enumerate(images):
            for j in range(i + 1, min(i + OVERLAP + 1, len(images))):
                second = images[j]
                if not database.exists_two_view_geometry(first.image_id, second.image_id):
                    continue
                geometry = database.read_two_view_geometry(first.image_id, second.image_id)
                matches = np.asarray(geometry.inlier_matches)
                if len(matches) < 15:
                    continue
                a = np.asarray(database.read_keypoints(first.image_id))[matches[:, 0], :2]
                b = np.asarray(database.read_keypoints(second.image_id))[matches[:, 1], :2]
                cv2.setRNGSeed(SEED)
                _, mask = cv2.findHomography(a, b, cv2.RANSAC, 3.0)
                flat, turn = 0.0, 0.0
                if mask is not None:
                    flat, on = float(mask.mean()), mask[:, 0] > 0
                    turn = turned(a - centre[0], b - centre[1], on, focals, TURN_PX * max(1.0, size / 640))
                pairs.append(Pair(i, j, len(matches), flat, turn))
    return pairs


def turned(a: Float64, b: Float64, on: Bool, focals: Float64, limit_px: float) -> float:
    """Fraction of matches that a turn on the spot explains, with the best of some focal lengths.

    Args:
        a, b: (N, 2) pixels from the picture's centre, of both frames.
        on: (N,) those to fit the turn to.
        focals: Of both frames, in pixels.
        limit_px: Off the turn at most.
    """
    best = 0.0
    if on.sum() < 3:
        return best
    for focal in focals.tolist():
        rays = [np.column_stack((xy, np.full(len(xy), focal))) for xy in (a, b)]
        rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]
        u, _, vt = np.linalg.svd(rays[1][on].T @ rays[0][on])
        R = u @ np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u @ vt))))) @ vt
        seen = rays[0] @ R.T
        ahead = np.maximum(seen[:, 2:], 1e-6)
        best = max(best, float((np.linalg.norm(focal * seen[:, :2] / ahead - b, axis=1) < limit_px).mean()))
    return best


def _tell(what: str, done: int, total: int) -> None:
    sys.stdout.write(f"{what} {done} {total}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
