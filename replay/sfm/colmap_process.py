"""What runs in COLMAP's process, see ``colmap``.

``python -m semantic_mapper.replay.sfm.colmap_process FOLDER`` reads ``request.json`` and ``features/NNNNNN.npz`` from
the folder, and writes a folder ``attempt-K/M`` for each model M of each attempt K, and ``result.json``. Each line on
stdout is progress: "what done total". ``... MODEL FILE`` writes a COLMAP model as arrays.
"""

import shutil
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import scipy  # loads `cluster` when it is first used
from numpy.typing import NDArray

from semantic_mapper.replay.sfm import colmap
from semantic_mapper.types import Bool, Float64, UInt8

DATABASE = "database.db"
OVERLAP = 8  # frames before each that it is matched to
PAIRS_AT_ONCE = 64
ENOUGH = 0.9  # of the frames in one model: no further focal length is tried
LEAST_FREE = 0.5  # of the frames, registered with a free focal length: it is not tried held
SEED = 1  # pycolmap takes 0 for "another each time"
INIT_TRIALS = 40
MAX_FOCAL_CHANGE = 0.1  # of one that is known about: EXIF data has whole millimetres, and the picture may be cropped
FOCAL_RANGE = 0.2, 5.0  # times the longer side; a model beyond it has run away
TURN_PX, TURN_FOCALS = 3.0, np.geomspace(0.4, 2.0, 12)  # off a turn at most, for 640 pixels; of the longer side
# Where a first attempt fails: two frames to begin with may lie straight ahead of each other, and the median angle
# between the rays to what both see may be this small. COLMAP's defaults, 0.95 and 16 degrees, leave none to a camera
# that goes forwards. It begins with the widest, and halves the angle twice.
AHEAD_MAX_FORWARD, AHEAD_ANGLE_DEG = 1.0, 8.0

WORDS, TRAIN_ROWS, ROUNDS = 32, 20_000, 8  # of the vocabulary that the film's own features make
LOOPS_A_FRAME = 3
MAX_ANGLE, MAX_ANGLE_RATIO = 0.7, 0.8  # radians between two descriptors of one thing, and of the angle to the second
MIN_SIMILARITY = 0.15  # of two frames that may show the same place; of two any frames it is about 0

pycolmap: Any = import_module("pycolmap")
pycolmap.logging.minloglevel = 3  # nothing but what ends the process


def main(folder: Path) -> None:
    """Match and map what is in a folder."""
    pycolmap.set_random_seed(SEED)
    camera = msgspec.json.decode((folder / colmap.REQUEST).read_bytes(), type=colmap.Camera)
    files = sorted((folder / colmap.FEATURES).glob("*.npz"))
    descriptors = _fill_database(folder / DATABASE, camera, files)
    _match(folder, [file.stem for file in files], descriptors, camera.precision)
    verified = _verified(folder / DATABASE, camera)
    turns = colmap.turn_fraction(verified, flat=True) >= 0.5
    outcome = colmap.Outcome(_attempts(folder, camera, len(files), turns=turns), verified)
    best = outcome.best
    if best.models:
        at = folder / best.models[0].folder
        focal = None if camera.fixed is None else _check_focal(at)
        known = camera.about and best.focal_prior_px == camera.focal_priors[0]
        sigma = _settle(at, camera, best.focal_prior_px, free=camera.fixed is None and not known)
        outcome = msgspec.structs.replace(outcome, focal=focal, focal_sigma=sigma)
    (folder / colmap.RESULT).write_bytes(msgspec.json.encode(outcome))


def write_arrays(folder: Path, file: Path) -> None:
    """Write the COLMAP model in a folder as arrays (.npz), see ``colmap.read_model``."""
    model = pycolmap.Reconstruction(folder)
    with tempfile.TemporaryDirectory() as scratch:  # COLMAP reads binary files that are cut off without a word
        model.write_binary(scratch)
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            if (folder / name).exists() and (folder / name).stat().st_size < (Path(scratch) / name).stat().st_size:
                raise ValueError(f"{folder / name} is cut off")
    points = {i: p for i, p in sorted(model.points3D.items()) if np.isfinite(p.xyz).all()}
    row = {number: k for k, number in enumerate(points)}
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    seen = [[p for p in image.get_observation_points2D() if p.point3D_id in row] for image in images]
    lenses = [(c.camera_id, c.model_name, c.width, c.height, c.params.tolist()) for c in model.cameras.values()]
    poses = [np.vstack((image.cam_from_world().matrix(), np.eye(4)[3])) for image in images]
    np.savez(
        file,
        cameras=np.array(msgspec.json.encode(lenses).decode()),
        names=np.array([image.name for image in images], np.str_),
        camera_ids=np.array([image.camera_id for image in images], np.int64),
        poses=np.array(poses, np.float64).reshape(-1, 4, 4),
        counts=np.array([len(sights) for sights in seen], np.int64),
        xy=np.array([p.xy for sights in seen for p in sights], np.float64).reshape(-1, 2),
        points=np.array([row[p.point3D_id] for sights in seen for p in sights], np.int64),
        xyz=np.array([p.xyz for p in points.values()], np.float64).reshape(-1, 3),
        errors_px=np.array([p.error for p in points.values()], np.float64),
    )


def _attempts(folder: Path, camera: colmap.Camera, count: int, *, turns: bool) -> list[colmap.Attempt]:
    """Until one has registered most frames; a camera that turns on the spot gets none that begins straight ahead.

    Straight ahead, the focal length is tried free. It is held only where that places next to nothing: two frames of a
    way without any turn fit all of them, and a wrong one that is held bends the path.
    """
    attempts: list[colmap.Attempt] = []
    for number, prior in enumerate(camera.focal_priors if camera.fixed is None else (camera.fixed[0],)):
        known = camera.about and number == 0
        for ahead, held in dict.fromkeys(((False, known), (True, known), (True, camera.fixed is None))):
            registered = max((a.models[0].images for a in attempts if a.models), default=0)
            if ahead and (turns or (held and not known and registered >= LEAST_FREE * count)):
                continue
            models = _map(folder, len(attempts), camera, prior, count, held=held, ahead=ahead)
            if known:
                models = [_freed(folder, model, prior) for model in models]
            attempts.append(colmap.Attempt(prior, models, ahead))
            if models and models[0].images >= ENOUGH * count:
                return attempts
    return attempts


def _fill_database(path: Path, camera: colmap.Camera, files: list[Path]) -> list[UInt8]:
    descriptors: list[UInt8] = []
    with pycolmap.Database.open(path) as database:
        camera_id = database.write_camera(_camera(camera, camera.focal_priors[0]))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(sensor)
        rig_id = database.write_rig(rig)
        for file in files:
            with np.load(file) as stored:
                xy, rows = stored["xy"], stored["descriptors"]
            image_id = database.write_image(pycolmap.Image(name=file.stem, camera_id=camera_id))
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(pycolmap.data_t(sensor, image_id))
            database.write_frame(frame)
            database.write_keypoints(image_id, (xy + 0.5).astype(np.float32))
            descriptors.append(rows)
    return descriptors


def _camera(camera: colmap.Camera, prior: float, *, held: bool = False) -> Any:
    return pycolmap.Camera(
        model="SIMPLE_RADIAL" if camera.fixed is None else "PINHOLE",
        width=camera.width,
        height=camera.height,
        params=list(camera.fixed or (prior, camera.width / 2, camera.height / 2, 0.0)),
        has_prior_focal_length=camera.fixed is not None or held,  # else COLMAP begins with one of its own
        camera_id=1,
    )


def _near_pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(i + 1, min(i + OVERLAP + 1, count))]


def _match(folder: Path, names: list[str], descriptors: list[UInt8], precision: float) -> None:
    pairs = _near_pairs(len(names)) + loop_pairs(descriptors, OVERLAP, SEED)
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
                _report("matching", done, len(pairs))
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    pycolmap.verify_matches(folder / DATABASE, listed, verification)
    _report("matching", len(pairs), len(pairs))


def match_features(a: UInt8, b: UInt8) -> NDArray[np.uint32]:
    """Rows (M, 2) of features (N, 128) that are each other's nearest, by angle, and clearly nearer than the second one.

    Every feature is compared with every other one: COLMAP's search through an index differs now and then between runs.
    Products of bytes are whole numbers below 2^24, so that the outcome is the same on any number of threads.
    """
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.uint32)
    alike = a.astype(np.float32) @ b.astype(np.float32).T
    best = alike.argmax(axis=1)
    rows = np.flatnonzero(alike.argmax(axis=0)[best] == np.arange(len(a)))
    pairs = rows, best[rows]
    near = alike[pairs]
    alike[pairs] = -1  # what is left is the second nearest
    second = np.maximum(alike[rows].max(axis=1), alike[:, best[rows]].max(axis=0))
    angle, next_angle = (np.arccos(np.minimum(x / 512.0**2, 1.0)) for x in (near, second))
    good = (angle < MAX_ANGLE) & (angle < MAX_ANGLE_RATIO * next_angle)
    return np.stack((pairs[0][good], pairs[1][good]), axis=1).astype(np.uint32)


def loop_pairs(descriptors: list[UInt8], window: int, seed: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of frames further than ``window`` apart that look alike, by their descriptors (N, 128).

    Frames are compared by the sums of their descriptors' residuals to a few words (VLAD), learned from all of them.
    """
    filled = [rows for rows in descriptors if len(rows)]
    if len(filled) <= window or sum(map(len, filled)) < 10 * WORDS:
        return []
    rng = np.random.default_rng(seed)
    each = max(1, TRAIN_ROWS // len(filled))
    sample = np.concatenate([rows[rng.permutation(len(rows))[:each]] for rows in filled]).astype(np.float64)
    words, _ = scipy.cluster.vq.kmeans2(sample, WORDS, ROUNDS, minit="points", rng=rng)
    signatures = np.stack([_signature(rows.astype(np.float64), words) for rows in descriptors])
    signatures -= signatures.mean(axis=0)
    signatures /= np.maximum(np.linalg.norm(signatures, axis=1, keepdims=True), 1e-9)
    alike = signatures @ signatures.T
    gap = np.abs(np.subtract.outer(np.arange(len(alike)), np.arange(len(alike))))
    alike[gap <= window] = -1
    pairs: set[tuple[int, int]] = set()
    for i, row in enumerate(alike):
        best = np.argsort(-row, kind="stable")[:LOOPS_A_FRAME]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in best if row[j] > MIN_SIMILARITY}
    return sorted(pairs)


def _signature(rows: Float64, words: Float64) -> Float64:
    sums = np.zeros_like(words)
    if len(rows):
        nearest, _ = scipy.cluster.vq.vq(rows, words)
        np.add.at(sums, nearest, rows - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9)


def _map(
    folder: Path, number: int, camera: colmap.Camera, prior: float, count: int, *, held: bool, ahead: bool
) -> list[colmap.Model]:
    """Models of one attempt, the largest first; ``held``: the focal length stays; ``ahead``: see ``Attempt``."""
    with pycolmap.Database.open(folder / DATABASE) as database:
        database.update_camera(_camera(camera, prior, held=held))
    options = pycolmap.IncrementalPipelineOptions()
    mapper, triangulation, precision = options.mapper, options.triangulation, camera.precision
    options.random_seed = mapper.random_seed = triangulation.random_seed = SEED
    options.num_threads = mapper.num_threads = 1  # several threads add up in another order each time
    options.min_model_size = colmap.MIN_MODEL_IMAGES
    options.max_num_models = 6
    options.init_num_trials = INIT_TRIALS
    options.extract_colors = False
    options.ba_refine_extra_params = mapper.abs_pose_refine_extra_params = camera.fixed is None
    options.ba_refine_focal_length = mapper.abs_pose_refine_focal_length = camera.fixed is None and not held
    if ahead:
        mapper.init_max_forward_motion = AHEAD_MAX_FORWARD
        mapper.init_min_tri_angle = AHEAD_ANGLE_DEG
    mapper.init_max_error *= precision
    mapper.abs_pose_max_error *= precision
    mapper.filter_max_reproj_error *= precision
    triangulation.merge_max_reproj_error *= precision
    triangulation.complete_max_reproj_error *= precision
    options.min_focal_length_ratio = mapper.min_focal_length_ratio = FOCAL_RANGE[0]
    options.max_focal_length_ratio = mapper.max_focal_length_ratio = FOCAL_RANGE[1]
    done = [0]

    def step(images: int) -> None:
        done[0] = min(done[0] + images, count)
        _report("poses", done[0], count)

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
    models = [model for model in models if FOCAL_RANGE[0] < model.focal_px / camera.size < FOCAL_RANGE[1]]
    return sorted(models, key=lambda model: (-model.images, model.error_px))


def _figures(folder: str, model: Any) -> colmap.Model:
    return colmap.Model(
        folder, model.num_reg_images(), float(model.compute_mean_reprojection_error()), _focal_px(model)
    )


def _focal_px(model: Any) -> float:
    return float(next(iter(model.cameras.values())).mean_focal_length())


def _adjustment(**options: bool) -> Any:
    """Options of a bundle adjustment in one thread: several add up in another order each time."""
    found = pycolmap.BundleAdjustmentOptions()
    found.print_summary = False
    found.ceres.solver_options.num_threads = 1
    for name, value in options.items():
        setattr(found, name, value)
    return found


def _freed(folder: Path, held: colmap.Model, prior: float) -> colmap.Model:
    """A model, adjusted with a free focal length; as it was where that runs away from the known one."""
    model = pycolmap.Reconstruction(folder / held.folder)
    pycolmap.bundle_adjustment(model, _adjustment())
    model.update_point_3d_errors()
    freed = _figures(held.folder, model)
    if abs(freed.focal_px / prior - 1) > MAX_FOCAL_CHANGE:
        return held
    model.write(folder / held.folder)
    return freed


def _check_focal(folder: Path) -> colmap.FocalCheck:
    """Adjust a model with its focal length as it is, then with a free one; the model on disk stays as it is.

    What the squared errors lose, over their mean, is the square of the difference in standard deviations.
    """
    model = pycolmap.Reconstruction(folder)
    errors, focal = list[float](), list[float]()
    for free in (False, True):
        pycolmap.bundle_adjustment(model, _adjustment(refine_extra_params=False, refine_focal_length=free))
        model.update_point_3d_errors()
        errors.append(_squared_px(model))
        focal.append(_focal_px(model))
    if errors[1] <= 0:
        return colmap.FocalCheck(1.0, 0.0)
    return colmap.FocalCheck(focal[1] / focal[0], (max(0.0, errors[0] / errors[1] - 1) * _free_values(model)) ** 0.5)


def _settle(folder: Path, camera: colmap.Camera, prior: float, *, free: bool) -> float | None:
    """Adjust the model in a folder until it converges; the standard deviation of a free focal length, as a fraction.

    A covariance belongs to the minimum, and while it maps, COLMAP ends its adjustments before that. A focal length that
    the film does not tell becomes the prior.
    """
    model = pycolmap.Reconstruction(folder)
    adjuster = _adjust(model, camera, free=free)
    sigma = _focal_sigma(model, camera, adjuster) if free and adjuster is not None else None
    if sigma is not None and sigma > colmap.UNKNOWN_FOCAL:
        model = pycolmap.Reconstruction(folder)
        lens = next(iter(model.cameras.values()))
        lens.params = [prior, *lens.params[1:]]
        adjuster = _adjust(model, camera, free=False)
    if adjuster is not None:
        model.write(folder)
    return sigma


def _adjust(model: Any, camera: colmap.Camera, *, free: bool) -> Any | None:
    """Adjust a model until it converges, with the first two cameras held; what did it, None if it failed."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = _adjustment(refine_focal_length=free, refine_extra_params=camera.fixed is None)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    usable = adjuster.solve().is_solution_usable()
    model.update_point_3d_errors()
    return adjuster if usable else None


def _focal_sigma(model: Any, camera: colmap.Camera, adjuster: Any) -> float | None:
    """Standard deviation of the focal length as a fraction, 1 at most; None = unknown."""
    focal = _focal_px(model)
    if not FOCAL_RANGE[0] < focal / camera.size < FOCAL_RANGE[1]:
        return 1.0
    covariance = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjuster)
    lens = next(iter(model.cameras.values()))
    of_lens = None if covariance is None else covariance.get_other_params_cov(lens.params)
    if of_lens is None:
        return None
    noise_px = np.sqrt(_squared_px(model) / max(1, _free_values(model)))  # of one coordinate of a feature
    return min(1.0, float(noise_px * np.sqrt(of_lens[0, 0])) / focal)


def _squared_px(model: Any) -> float:
    return sum(point.track.length() * point.error**2 for point in model.points3D.values())


def _free_values(model: Any) -> int:
    """Measurements beyond those that make the model."""
    seen = sum(point.track.length() for point in model.points3D.values())
    return max(0, 2 * seen - 6 * model.num_reg_images() - 3 * len(model.points3D))


def _verified(path: Path, camera: colmap.Camera) -> list[colmap.Pair]:
    """Pairs of frames near each other in the sequence, whose matches agree."""
    focals = TURN_FOCALS * camera.size if camera.fixed is None else np.array(camera.fixed[:1])
    centre = np.array((camera.width / 2, camera.height / 2) if camera.fixed is None else camera.fixed[2:])
    pairs: list[colmap.Pair] = []
    with pycolmap.Database.open(path) as database:
        ids = [image.image_id for image in sorted(database.read_all_images(), key=lambda image: image.name)]
        for i, j in _near_pairs(len(ids)):
            if not database.exists_two_view_geometry(ids[i], ids[j]):
                continue
            matches = np.asarray(database.read_two_view_geometry(ids[i], ids[j]).inlier_matches)
            if len(matches) < 15:
                continue
            a = np.asarray(database.read_keypoints(ids[i]))[matches[:, 0], :2]
            b = np.asarray(database.read_keypoints(ids[j]))[matches[:, 1], :2]
            cv2.setRNGSeed(SEED)
            _, mask = cv2.findHomography(a, b, cv2.RANSAC, 3.0)
            flat, turn = 0.0, 0.0
            if mask is not None and mask.sum() >= 3:
                flat = float(mask.mean())
                turn = _turned(a - centre, b - centre, mask[:, 0] > 0, focals, TURN_PX * max(1.0, camera.size / 640))
            pairs.append(colmap.Pair(i, j, len(matches), flat, turn))
    return pairs


def _turned(a: Float64, b: Float64, on: Bool, focals: Float64, limit_px: float) -> float:
    """Fraction of matches that a turn on the spot explains, with the best of some focal lengths.

    ``a`` and ``b`` (N, 2) are pixels from the picture's centre in both frames; the turn is fitted to those ``on`` (N,).
    """
    best = 0.0
    for focal in focals.tolist():
        rays = [np.column_stack((xy, np.full(len(xy), focal))) for xy in (a, b)]
        rays = [r / np.linalg.norm(r, axis=1, keepdims=True) for r in rays]
        u, _, vt = np.linalg.svd(rays[1][on].T @ rays[0][on])
        R = u @ np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u @ vt))))) @ vt
        seen = rays[0] @ R.T
        ahead = np.maximum(seen[:, 2:], 1e-6)
        best = max(best, float((np.linalg.norm(focal * seen[:, :2] / ahead - b, axis=1) < limit_px).mean()))
    return best


def _report(what: str, done: int, total: int) -> None:
    sys.stdout.write(f"{what} {done} {total}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    paths = [Path(argument) for argument in sys.argv[1:]]
    if len(paths) == 2:
        write_arrays(*paths)
    else:
        main(*paths)
