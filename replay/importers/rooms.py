"""Data sets of rooms: ScanNet and Replica.

ScanNet scenes as its tools export them: poses are -inf where tracking was lost. Colour is larger than depth (1296x968
against 640x480) and both cameras are taken to stand in one point, as the data set's extrinsics say. So each depth
pixel's ray hits the colour image at ``K_color @ inv(K_depth) @ pixel``, whatever its depth: colour and labels are
resampled to the depth image's pixels (colour by area, labels by nearest pixel), and the depth camera's intrinsics hold.
Depth itself is not touched.

Replica rooms as rendered for Semantic-NeRF: one sequence of one scene, ``SCENE/Sequence_1`` (or 2). The layout and the
units are those that ``SSR/datasets/replica/replica_datasets.py`` of https://github.com/Harry-Zhi/semantic_nerf reads;
the camera is the one of its ``SSR/training/trainer.py``: 640x480, horizontal field of view 90 degrees, so fx = fy =
320, and the principal point in the middle. Another image size keeps that field of view. Class names come from Replica's
own ``info_semantic.json``, which is looked for in the sequence's folder, the scene's, its ``habitat``, and in
``semantic_info/SCENE`` next to the scenes.

Replica rooms as rendered for NICE-SLAM: ``traj.txt`` has OpenCV's axes, and one ``cam_params.json`` is for all rooms.
"""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from semantic_mapper.errors import ImportSourceError, LabelError
from semantic_mapper.labels import NYU40, LabelSet, make_label_set
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import (
    DEPTHS,
    PICTURES,
    BadFrameError,
    DepthScale,
    ImportOptions,
    camera_of,
    check_label,
    first_size,
    read_depth,
    read_plane,
    read_rgb,
)
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

SCANNET_SCALE = DepthScale(1000.0, convention="ScanNet's millimetres")
SCANNET_HZ = 30.0
_TABLE = "scannetv2-labels.combined.tsv"


def open_scannet(folder: Path, options: ImportOptions) -> PosedPictures:
    """An exported scene, opened; one frame for each colour image.

    Raises ImportSourceError: intrinsics or images are missing.
    """
    notices: list[str] = []
    color = tables.numbered_files(folder / "color", PICTURES, notices)
    depth = tables.numbered_files(folder / "depth", DEPTHS, notices)
    poses = tables.numbered_files(folder / "pose", (".txt",), notices)
    notices += tables.without_picture("pose", poses, color, folder / "color")
    names = [name for name in ("label-filt", "label") if (folder / name).is_dir()]
    labels = tables.numbered_files(folder / names[0], (".png",), notices) if names else {}
    own = _scannet_intrinsics(folder, "color", color.values())
    view = None if options.without_depth else _scannet_intrinsics(folder, "depth", depth.values())
    for which in ("color", "depth"):
        file = folder / "intrinsic" / f"extrinsic_{which}.txt"
        if file.exists() and not np.allclose(tables.read_matrix(file), np.eye(4), atol=5e-3):
            notices.append(f"{file.name} is not the identity; it is ignored, colour may be off by its parallax")
    pictures = [
        PosedPicture(
            file,
            own,
            _scannet_pose(poses.get(number, folder / "pose" / f"{number}.txt")),
            round(number * 1e9 / SCANNET_HZ),  # exports that keep each n-th frame keep its number
            depth_file=depth.get(number),
            label_file=labels.get(number),
            view=view,
        )
        for number, file in color.items()
    ]
    nyu40_of_raw = _scannet_table(folder)

    def read_label(file: Path, label_set: LabelSet, size: tuple[int, int]) -> UInt8:
        image = read_plane(file, "any", size, "label")
        if image.dtype == np.uint8:
            return check_label(image.astype(np.uint8), label_set, file)
        if nyu40_of_raw is None:
            raise BadFrameError(file, f"holds ScanNet's raw class ids; put the data set's {_TABLE} into {folder}")
        return check_label(nyu40_of_raw[image.astype(np.int64)], label_set, file)

    source = f"scannet {folder.resolve().name}"
    label_set = NYU40 if labels else None
    return PosedPictures(
        source, pictures, options, SCANNET_SCALE, notices, hz=SCANNET_HZ, labels=label_set, read_label=read_label
    )


def _scannet_pose(file: Path) -> Float64 | BadFrameError:
    try:
        pose = tables.read_matrix(file)
    except BadFrameError as error:
        return error
    lost = BadFrameError(file, "the scanner had lost track of its pose here (-inf)")
    return pose if np.isfinite(pose).all() else lost


def _scannet_table(folder: Path) -> UInt8 | None:
    """Raw id -> NYU40 id, 0 for unknown: (65536,); None without the data set's table."""
    here = folder.resolve()
    file = next((place / _TABLE for place in (here, *here.parents[:2]) if (place / _TABLE).exists()), None)
    if file is None:
        return None
    table = np.zeros(1 << 16, np.uint8)
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            for row in csv.DictReader(lines, delimiter="\t"):
                table[int(row["id"])] = int(row["nyu40id"] or 0)
    except (OSError, KeyError, ValueError, TypeError, IndexError, OverflowError, csv.Error) as error:
        raise ImportSourceError(f"{file}: has no columns 'id' and 'nyu40id' of numbers: {error}") from error
    return table


def _scannet_intrinsics(folder: Path, which: str, images: Iterable[Path]) -> CameraIntrinsics:
    places = (folder / "intrinsic" / f"intrinsic_{which}.txt", folder / f"intrinsics_{which}.txt")
    file = next((place for place in places if place.exists()), places[0])
    K = tables.read_matrix(file)
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]) or np.any(np.abs(K[[1, 2, 2], [0, 0, 1]]) > 1e-9):
        raise ImportSourceError(f"{file}: is no matrix of a camera without skew, which is the one that is read")
    for image in images:
        try:
            height, width = read_rgb(image)[0].shape[:2] if which == "color" else read_depth(image, SCANNET_SCALE).shape
        except BadFrameError:  # reported when its turn comes
            continue
        found = camera_of(file, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), (width, height))
        if not (0.25 * width < found.cx < 0.75 * width and 0.25 * height < found.cy < 0.75 * height):
            raise ImportSourceError(
                f"{file}: its principal point ({found.cx:g}, {found.cy:g}) is far from the middle of images of "
                f"{width}x{height}: they were resized, or cut; scale the matrix with them"
            )
        return found
    raise ImportSourceError(f"{folder / which}: no image, named by number, that can be read")


REPLICA_SCALE = DepthScale(1000.0, convention="millimetres, as Semantic-NeRF's renderer writes them")
REPLICA_HZ = 30.0  # the renderer has no clock; its path moves like a hand-held camera at this rate
REPLICA_HFOV_DEG = 90.0
_INFO, _PARAMS = "info_semantic.json", "cam_params.json"


class _Class(msgspec.Struct):
    id: int
    name: str


class _Info(msgspec.Struct):
    classes: list[_Class]


def open_replica(folder: Path, options: ImportOptions) -> PosedPictures:
    """A sequence, opened; one frame for each colour image. Raises ImportSourceError: images or poses are missing."""
    notices: list[str] = []
    color = tables.numbered_files(folder / "rgb", (".png",), notices)
    depth = tables.numbered_files(folder / "depth", DEPTHS, notices)
    labels = tables.numbered_files(folder / "semantic_class", (".png",), notices)
    poses = tables.read_pose_rows(folder / "traj_w_c.txt", color.keys())
    notices += tables.without_picture("depth image", depth, color, folder / "rgb")
    size = first_size(color.values(), folder / "rgb")
    f = size[0] / 2 / np.tan(np.deg2rad(REPLICA_HFOV_DEG) / 2)
    intrinsics = camera_of(folder / "rgb", (f, f, (size[0] - 1) / 2, (size[1] - 1) / 2), size)
    pictures = [
        PosedPicture(
            file,
            intrinsics,
            poses[number],
            round(number * 1e9 / REPLICA_HZ),
            depth_file=depth.get(number),
            label_file=labels.get(number),
        )
        for number, file in color.items()
    ]
    here = folder.resolve()
    label_set = _replica_labels(here, notices) if labels else None
    source = f"replica {here.parent.name} {here.name}"
    return PosedPictures(source, pictures, options, REPLICA_SCALE, notices, hz=REPLICA_HZ, labels=label_set)


class _Camera(msgspec.Struct):
    w: float
    h: float
    fx: float
    fy: float
    cx: float
    cy: float
    scale: Annotated[float, msgspec.Meta(gt=0)]  # units of depth per metre


def open_nice_slam(folder: Path, options: ImportOptions) -> PosedPictures:
    """A room, opened; one frame for each image. Raises ImportSourceError: images, poses or camera are missing."""
    notices: list[str] = []
    here = folder.resolve()
    file = next((f for f in (here / _PARAMS, here.parent / _PARAMS) if f.exists()), here.parent / _PARAMS)
    k = tables.convert_known(tables.read_plain_json(file).get("camera"), _Camera, file)
    intrinsics = camera_of(file, (k.fx, k.fy, k.cx, k.cy), (k.w, k.h))
    color = tables.numbered_files(folder / "results", (".jpg",), notices)
    depth = tables.numbered_files(folder / "results", (".png",), notices)
    poses = tables.read_pose_rows(folder / "traj.txt", color.keys())
    pictures = [
        PosedPicture(image, intrinsics, poses[number], round(number * 1e9 / REPLICA_HZ), depth.get(number), seq=number)
        for number, image in color.items()
    ]
    return PosedPictures(f"replica {here.name}", pictures, options, DepthScale(k.scale, file), notices, hz=REPLICA_HZ)


def _replica_labels(here: Path, notices: list[str]) -> LabelSet | None:
    scene = here.parent
    places = (here, scene, scene / "habitat", scene.parent / "semantic_info" / scene.name)
    file = next((place / _INFO for place in places if (place / _INFO).exists()), None)
    if file is None:
        notices.append(
            f"semantic_class/ is left out: {_INFO}, which names its classes, is in none of "
            f"{', '.join(map(str, places))}; Replica has it for each scene"
        )
        return None
    classes = {
        c.id: c.name for c in tables.convert_known(tables.read_plain_json(file), _Info, file).classes if c.id > 0
    }
    try:
        return make_label_set("replica", list(classes.values()), ids=list(classes))
    except LabelError as error:
        raise ImportSourceError(f"{file}: {error}") from error
