"""The process in which pycolmap runs: a crash of its native code, or Ctrl-C, ends this process alone.

``python -m semantic_mapper.replay.sfm.colmap_process FOLDER`` reads ``request.json`` and ``features/NNNNNN.npz`` from
the folder, and writes a folder ``attempt-K/M`` for each model M of each attempt K, and ``result.json``. Each line on
stdout is progress: "what done total".
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.replay.sfm.features import loop_pairs, match_features
from semantic_mapper.types import UInt8

REQUEST, RESULT, DATABASE, FEATURES = "request.json", "result.json", "database.db", "features"
OVERLAP = 8  # frames before each that it is matched to
PAIRS_AT_ONCE = 64
ENOUGH = 0.9  # of the frames in one model: no further focal length is tried
SEED = 1  # pycolmap takes 0 for "another each time"
MIN_MODEL_IMAGES = 5
INIT_TRIALS = 40
LARGE, LEAST_PRECISION = 1280, 0.25  # pixels of the longer side from which on COLMAP's limits hold; their least factor
MAX_FOCAL_CHANGE = 0.1  # of one that is known about: EXIF data has whole millimetres, and the picture may be cropped
FOCAL_RANGE = 0.2, 5.0  # times the longer side; a model beyond it has run away


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
    """What came of one focal length."""

    focal_prior_px: float
    models: list[Model]


class Pair(msgspec.Struct, frozen=True):
    """Two frames, by their places in the sequence, with matches that agree with one geometry.

    Args:
        first, second: The frames.
        matches: That agree.
        flat: Of these, the fraction that one homography explains: 1 for a camera that only turns, or one plane.
    """

    first: int
    second: int
    matches: int
    flat: float


class FocalCheck(msgspec.Struct, frozen=True):
    """What the pictures say of a given focal length.

    Args:
        factor: By which it has to be multiplied to fit them best.
        sigmas: How sure that is: the difference over its own standard deviation.
    """

    factor: float
    sigmas: float


class Outcome(msgspec.Struct, frozen=True):
    """All that the process tells; ``focal`` of the largest model of a calibrated camera."""

    attempts: list[Attempt]
    pairs: list[Pair]
    features: list[int]
    focal: FocalCheck | None = None


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
    attempts: list[Attempt] = []
    for number, prior in enumerate(camera.focal_priors if camera.fixed is None else (camera.fixed[0],)):
        models = _map(pycolmap, folder, number, camera, prior, len(files), held=camera.about and number == 0)
        attempts.append(Attempt(prior, models))
        if models and models[0].images >= ENOUGH * len(files):
            break
    counts = [len(rows) for rows in descriptors]
    models = attempts[0].models
    focal = _check_focal(pycolmap, folder / models[0].folder) if camera.fixed is not None and models else None
    outcome = Outcome(attempts, _verified(pycolmap, folder / DATABASE, OVERLAP), counts, focal)
    (folder / RESULT).write_bytes(msgspec.json.encode(outcome))


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


def _camera(pycolmap: Any, camera: Camera, prior: float) -> Any:
    if camera.fixed is not None:
        model, params = "PINHOLE", list(camera.fixed)
    else:
        model, params = "SIMPLE_RADIAL", [prior, camera.width / 2, camera.height / 2, 0.0]
    return pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=params,
        has_prior_focal_length=camera.fixed is not None,
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
    pycolmap: Any, folder: Path, number: int, camera: Camera, prior: float, count: int, *, held: bool
) -> list[Model]:
    """Models of one attempt, the largest first; ``held``: the focal length is about right, and freed at the end."""
    with pycolmap.Database.open(folder / DATABASE) as database:
        database.update_camera(_camera(pycolmap, camera, prior))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = 1  # several threads add up in another order each time
    options.min_model_size = MIN_MODEL_IMAGES
    options.max_num_models = 6
    options.init_num_trials = INIT_TRIALS
    options.extract_colors = False
    options.ba_refine_extra_params = camera.fixed is None
    options.ba_refine_focal_length = camera.fixed is None and not held
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
    if held:
        found = {index: _freed(pycolmap, out / str(index), prior) for index in found}
    models = [
        Model(
            folder=f"{out.name}/{index}",
            images=model.num_reg_images(),
            error_px=float(model.compute_mean_reprojection_error()),
            focal_px=float(next(iter(model.cameras.values())).mean_focal_length()),
        )
        for index, model in found.items()
    ]
    size = max(camera.width, camera.height)
    models = [model for model in models if FOCAL_RANGE[0] < model.focal_px / size < FOCAL_RANGE[1]]
    return sorted(models, key=lambda model: (-model.images, model.error_px))


def _freed(pycolmap: Any, folder: Path, prior: float) -> Any:
    """The model in a folder, adjusted with a free focal length; as it was where that runs away from the known one."""
    held, model = pycolmap.Reconstruction(folder), pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1  # as above
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()
    focal = float(next(iter(model.cameras.values())).mean_focal_length())
    if abs(focal / prior - 1) > MAX_FOCAL_CHANGE:
        return held
    model.write(folder)
    return model


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


def _precision(camera: Camera) -> float:
    """Factor of COLMAP's limits in pixels, which are for large photographs."""
    return min(1.0, max(LEAST_PRECISION, max(camera.width, camera.height) / LARGE))


def _verified(pycolmap: Any, path: Path, window: int) -> list[Pair]:
    """Pairs of frames near each other in the sequence, whose matches agree."""
    import cv2

    pairs: list[Pair] = []
    with pycolmap.Database.open(path) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        for i, first in enumerate(images):
            for j in range(i + 1, min(i + window + 1, len(images))):
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
                flat = 0.0 if mask is None else float(mask.mean())
                pairs.append(Pair(i, j, len(matches), flat))
    return pairs


def _tell(what: str, done: int, total: int) -> None:
    sys.stdout.write(f"{what} {done} {total}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
