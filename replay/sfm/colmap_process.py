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

from semantic_mapper.replay.sfm.features import loop_pairs

REQUEST, RESULT, DATABASE, FEATURES = "request.json", "result.json", "database.db", "features"
OVERLAP = 8  # frames before each that it is matched to
PAIRS_AT_ONCE = 64
ENOUGH = 0.9  # of the frames in one model: no further focal length is tried
SEED = 1  # pycolmap takes 0 for "another each time"
MIN_MODEL_IMAGES = 5
INIT_TRIALS = 40


class Camera(msgspec.Struct, frozen=True):
    """The camera of all frames, in COLMAP's convention: the first pixel's centre is at 0.5.

    Args:
        width, height: Of the frames.
        fixed: fx, fy, cx, cy of a calibrated camera, which stay; None = not calibrated.
        focal_priors: Focal lengths to begin with, in this order, until most frames find their place; not calibrated.
    """

    width: int
    height: int
    fixed: tuple[float, float, float, float] | None
    focal_priors: tuple[float, ...]


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


class Outcome(msgspec.Struct, frozen=True):
    """All that the process tells."""

    attempts: list[Attempt]
    pairs: list[Pair]
    features: list[int]


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
    _match(pycolmap, folder, [file.stem for file in files], pairs)
    attempts: list[Attempt] = []
    for number, prior in enumerate(camera.focal_priors if camera.fixed is None else (camera.fixed[0],)):
        models = _map(pycolmap, folder, number, camera, prior, len(files))
        attempts.append(Attempt(prior, models))
        if models and models[0].images >= ENOUGH * len(files):
            break
    counts = [len(rows) for rows in descriptors]
    outcome = Outcome(attempts, _verified(pycolmap, folder / DATABASE, OVERLAP), counts)
    (folder / RESULT).write_bytes(msgspec.json.encode(outcome))


def _fill_database(pycolmap: Any, path: Path, camera: Camera, files: list[Path]) -> list[np.ndarray]:
    descriptors: list[np.ndarray] = []
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
            database.write_descriptors(
                image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(rows))
            )
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


def _match(pycolmap: Any, folder: Path, names: list[str], pairs: list[tuple[int, int]]) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.compute_relative_pose = False
    matching = pycolmap.FeatureMatchingOptions()
    matching.sift.cpu_brute_force_matcher = True  # the search through an index differs now and then between runs
    listed = folder / "pairs.txt"
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        chosen = pairs[start : start + PAIRS_AT_ONCE]
        listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in chosen), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        pycolmap.match_image_pairs(
            folder / DATABASE,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        _tell("match", min(start + PAIRS_AT_ONCE, len(pairs)), len(pairs))


def _map(pycolmap: Any, folder: Path, number: int, camera: Camera, prior: float, count: int) -> list[Model]:
    """Models of one attempt, the largest first."""
    with pycolmap.Database.open(folder / DATABASE) as database:
        database.update_camera(_camera(pycolmap, camera, prior))
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.num_threads = options.mapper.num_threads = 1  # several threads add up in another order each time
    options.min_model_size = MIN_MODEL_IMAGES
    options.max_num_models = 6
    options.init_num_trials = INIT_TRIALS
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = camera.fixed is None
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = camera.fixed is None
    options.min_focal_length_ratio = options.mapper.min_focal_length_ratio = 0.2
    options.max_focal_length_ratio = options.mapper.max_focal_length_ratio = 5.0
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
    models = [
        Model(
            folder=f"{out.name}/{index}",
            images=model.num_reg_images(),
            error_px=float(model.compute_mean_reprojection_error()),
            focal_px=float(next(iter(model.cameras.values())).mean_focal_length()),
        )
        for index, model in found.items()
    ]
    return sorted(models, key=lambda model: (-model.images, model.error_px))


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
