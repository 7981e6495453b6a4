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
MAX_POINT_SIGMAS = 2000  # points whose depths are judged
UNKNOWN_FOCAL = 0.3  # standard deviation of a focal length that usual lenses tell better than the film: it is assumed


class Camera(msgspec.Struct, frozen=True):
    """The camera of all frames, in COLMAP's convention: the first pixel's centre is at 0.5.

    Args:
        width, height: Of the frames.
        fixed: fx, fy, cx, cy of a calibrated camera, which stay; None = not calibrated.
        focal_priors: Focal lengths to begin with, in this order, until most frames find their place; not calibrated.
        about: The first of these is known about, and held until all frames have their place. Rows of pictures over flat
            ground fit a wrong one as well.
    """

    width: int
    height: int
    fixed: tuple[float, float, float, float] | None
    focal_priors: tuple[float, ...]
    about: bool = False


class Model(msgspec.Struct, frozen=True):
    """One model that an attempt has given.

    Args:
        folder: With COLMAP's binary files.
        images: Registered.
        error_px: Mean reprojection error.
        focal_px: Found or given.
    """

    folder: str
    images: int
    error_px: float
    focal_px: float


class Attempt(msgspec.Struct, frozen=True):
    """What came of one focal length.

    Args:
        focal_prior_px: To begin with.
        models: The largest first.
        ahead: Begun with two frames that may lie straight ahead of each other.
    """

    focal_prior_px: float
    models: list[Model]
    ahead: bool = False


class Pair(msgspec.Struct, frozen=True):
    """Two frames, by their places in the sequence, with matches that agree with one geometry.

    Args:
        first, second: The frames.
        matches: That agree.
        flat: Of these, the fraction that one homography explains: 1 for a camera that only turns, or one plane.
        turn: The fraction that a turn on the spot explains.
    """

    first: int
    second: int
    matches: int
    flat: float
    turn: float = 0.0


class FocalCheck(msgspec.Struct, frozen=True):
    """What the pictures say of a given focal length.

    Args:
        factor: By which it has to be multiplied to fit them best.
        sigmas: How sure that is: the difference over its own standard deviation.
    """

    factor: float
    sigmas: float


class Sigmas(msgspec.Struct, frozen=True):
    """Standard deviations of a model, by the covariance of its bundle adjustment: noise of the features alone.

    Args:
        focal: Of the focal length, as a fraction of it, 1 at most; None where it was not free. Above ``UNKNOWN_FOCAL``
            the model has the one that the attempt was given.
        position: Of the place of a camera, the largest, as a fraction of the path, with the path's beginning held.
        depth: Of the depths of points, with the cameras held: the median of their fractions.
    """

    focal: float | None
    position: float
    depth: float


class Outcome(msgspec.Struct, frozen=True):
    """All that the process tells.

    Args:
        attempts: In the order of trial.
        pairs: Of frames near each other.
        features: Of each frame.
        focal: Of the largest model of a calibrated camera.
        sigmas: Of the largest model of the best attempt; None where the adjustment is degenerate.
    """

    attempts: list[Attempt]
    pairs: list[Pair]
    features: list[int]
    focal: FocalCheck | None = None
    sigmas: Sigmas | None = None


def best_attempt(attempts: Sequence[Attempt]) -> int:
    """The one with the largest model, of equal ones that with the smallest error."""
    sizes = [(a.models[0].images, -a.models[0].error_px) if a.models else (0, 0.0) for a in attempts]
    return max(range(len(attempts)), key=sizes.__getitem__)


def flat_fraction(pairs: Sequence[Pair]) -> float:
    """Of the pairs some steps apart, those that one homography explains."""
    apart = [p for p in pairs if p.second - p.first >= 2 and p.matches >= LINK_MATCHES]
    return float(np.mean([p.flat >= FLAT for p in apart])) if apart else 0.0


def turn_fraction(pairs: Sequence[Pair]) -> float:
    """Of the pairs some steps apart, those that a turn on the spot explains."""
    apart = [p for p in pairs if p.second - p.first >= 2 and p.matches >= LINK_MATCHES]
    return float(np.mean([p.turn >= TURNED for p in apart])) if apart else 0.0


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
    turns = max(flat_fraction(verified), turn_fraction(verified)) >= 0.5
    attempts = _attempts(pycolmap, folder, camera, len(files), turns=turns)
    counts = [len(rows) for rows in descriptors]
    best = attempts[best_attempt(attempts)]
    focal = sigmas = None
    if best.models:
        at = folder / best.models[0].folder
        focal = None if camera.fixed is None else _check_focal(pycolmap, at)
        known = camera.about and best.focal_prior_px == camera.focal_priors[0]
        sigmas = _settle(pycolmap, at, camera, best.focal_prior_px, free=camera.fixed is None and not known)
    outcome = Outcome(attempts, verified, counts, focal, sigmas)
    (folder / RESULT).write_bytes(msgspec.json.encode(outcome))


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


def _freed(pycolmap: Any, folder: Path, held: Model, prior: float) -> Model:
    """A model, adjusted with a free focal length; as it was where that runs away from the known one."""
    model = pycolmap.Reconstruction(folder / held.folder)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1  # as above
    pycolmap.bundle_adjustment(model, options)
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
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = options.print_summary = False
    options.ceres.solver_options.num_threads = 1  # as above
    errors, focal = list[float](), list[float]()
    for free in (False, True):
        options.refine_focal_length = free
        pycolmap.bundle_adjustment(model, options)
        model.update_point_3d_errors()
        errors.append(sum(point.track.length() * point.error**2 for point in model.points3D.values()))
        focal.append(float(next(iter(model.cameras.values())).mean_focal_length()))
    seen = sum(point.track.length() for point in model.points3D.values())
    free_values = 2 * seen - 6 * model.num_reg_images() - 3 * len(model.points3D)
    if free_values <= 0 or errors[1] <= 0:
        return FocalCheck(1.0, 0.0)
    return FocalCheck(focal[1] / focal[0], (max(0.0, errors[0] - errors[1]) * free_values / errors[1]) ** 0.5)


def _settle(
    pycolmap: Any, folder: Path, camera: Camera, prior: float, *, free: bool, assumed: bool = False
) -> Sigmas | None:
    """Adjust the model in a folder until it converges, and say how exact it is; None where that is unknown.

    A covariance belongs to the minimum, and while it maps, COLMAP ends its adjustments before that.

    Args:
        pycolmap, folder, camera, prior: What to adjust.
        free: The focal length.
        assumed: The focal length becomes the prior, and stays.
    """
    model = pycolmap.Reconstruction(folder)
    lens = next(iter(model.cameras.values()))
    if assumed:
        lens.params = [prior, *lens.params[1:]]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params = free, camera.fixed is None
    options.ceres.solver_options.num_threads = 1  # as above
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    if not adjuster.solve().is_solution_usable():
        return None
    focal = float(lens.mean_focal_length())
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    model.update_point_3d_errors()
    noise_px = _noise_px(model)
    if covariance is None:
        return None
    of_lens = covariance.get_other_params_cov(lens.params) if free else None
    of_focal = None if of_lens is None else min(1.0, noise_px * float(np.sqrt(of_lens[0, 0])) / focal)
    in_range = FOCAL_RANGE[0] < focal / max(camera.width, camera.height) < FOCAL_RANGE[1]
    if of_focal is not None and (of_focal > UNKNOWN_FOCAL or not in_range):
        held = _settle(pycolmap, folder, camera, prior, free=False, assumed=True)
        return None if held is None else msgspec.structs.replace(held, focal=1.0 if not in_range else of_focal)
    model.write(folder)
    return Sigmas(of_focal, noise_px * _position_sigma(model, covariance), noise_px * _depth_sigma(model, covariance))


def _noise_px(model: Any) -> float:
    """Standard deviation of one coordinate of a feature, by the residuals."""
    points = model.points3D.values()
    seen = sum(point.track.length() for point in points)
    squares = sum(point.track.length() * point.error**2 for point in points)
    return float(np.sqrt(squares / max(1, 2 * seen - 6 * model.num_reg_images() - 3 * len(points))))


def _position_sigma(model: Any, covariance: Any) -> float:
    """Largest of a camera's place over the length of the path, for features that are off by a pixel."""
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    places = np.stack([image.projection_center() for image in images])
    way = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    largest = 0.0
    for image in images:
        of_pose = covariance.get_cam_cov_from_world(image.image_id)
        if of_pose is None or of_pose.shape != (6, 6):
            continue  # held
        R, (x, y, z) = image.cam_from_world().rotation.matrix(), image.cam_from_world().translation
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        # The place is -R^T t. Ceres' tangent of a quaternion is half the angle.
        jacobian = np.hstack((-2 * R.T @ across, -R.T))
        largest = max(largest, float(np.sqrt(np.trace(jacobian @ of_pose @ jacobian.T))))
    return largest / max(way, 1e-12)


def _depth_sigma(model: Any, covariance: Any) -> float:
    """Median of the points' depths as fractions, along the ray from the first frame that sees each; as above."""
    ids = sorted(model.points3D)
    fractions: list[float] = []
    for point_id in ids[:: max(1, len(ids) // MAX_POINT_SIGMAS)]:
        of_point, point = covariance.get_point_cov(point_id), model.points3D[point_id]
        if of_point is not None:
            ray = point.xyz - model.images[point.track.elements[0].image_id].projection_center()
            fractions.append(float(np.sqrt(ray @ of_point @ ray)) / float(ray @ ray))
    return float(np.median(fractions)) if fractions else 0.0


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
