"""The sequence folder. A frame may lack depth and label.

``export`` also writes ``pseudo_label/NNNNNN.png``, labels that weights have rendered, and ``computed_depth/NNNNNN.png``
with its one-sigma spread in ``depth_sigma/NNNNNN.png``: they come back with that mark, for frames without the other.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from semantic_mapper.errors import ImportSourceError, LabelError
from semantic_mapper.labels import MAX_NAME, PROVIDED, LabelSet, make_label_set
from semantic_mapper.replay.importers import tables
from semantic_mapper.replay.importers.base import DEPTHS, PICTURES, DepthScale, ImportOptions, camera_of, first_size
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.transport.messages import SCALE_UNKNOWN
from semantic_mapper.types import CameraIntrinsics

PSEUDO_LABEL, COMPUTED_DEPTH, DEPTH_SIGMA = "pseudo_label", "computed_depth", "depth_sigma"  # folders
DEFAULT_HZ = 6.0  # of a recording without timestamps.txt
DEPTH_SCALE = DepthScale(1000.0, convention="millimetres; another one belongs into intrinsics.json as depth_scale")
_OTHER_LENS = re.compile(r"dist\w+|coeffs|D|(distortion_|lens_)?model")  # keys of other programs


class _Intrinsics(msgspec.Struct):
    fx: float
    fy: float
    cx: float
    cy: float
    width: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None  # None = that of the first image
    height: Annotated[float, Meta(ge=1, le=1 << 14)] | None = None
    distortion: tuple[float, ...] | None = None  # OpenCV's coefficients
    fisheye: bool = False  # of its fisheye model
    camera_model: str = "opencv"  # the lens, by a name that ROS, COLMAP or Kalibr give it
    depth_scale: Annotated[float, Meta(gt=0, le=1e6)] | None = None  # units per metre; None = the format's convention
    scale: str = ""  # "unknown" where poses are not in metres


class _Labels(msgspec.Struct):
    classes: dict[str, str]
    id_space: str = ""
    colors: dict[str, tuple[int, int, int]] = msgspec.field(default_factory=dict)
    # The id that means unknown; null = none of those in the images. Missing: 0, as most data sets have it.
    ignore: Annotated[int, Meta(ge=0, le=255)] | msgspec.UnsetType | None = msgspec.UNSET


def open_folder(folder: Path, options: ImportOptions) -> PosedPictures:
    """A sequence folder, opened.

    Raises ImportSourceError: a file that concerns all frames is missing or cannot be understood.
    """
    notices: list[str] = []
    color = tables.numbered_files(folder / "color", PICTURES, notices)
    if not color:
        raise ImportSourceError(f"{folder / 'color'}: no images named by number (000000.jpg or .png)")
    lens, given, scale_from = read_intrinsics(folder / "intrinsics.json", notices, list(color.values()))
    poses = tables.read_pose_rows(folder / "poses.txt", color.keys())
    notices += tables.without_picture("row of poses.txt", poses, color, folder / "color")
    stamps = tables.read_stamps(folder / "timestamps.txt", max(color) + 1, DEFAULT_HZ, notices)
    depth, computed, sigma, labels, pseudo = (
        tables.numbered_files(folder / name, suffixes, notices)
        for name, suffixes in (
            ("depth", DEPTHS),
            (COMPUTED_DEPTH, (".png",)),
            (DEPTH_SIGMA, (".png",)),
            ("label", (".png",)),
            (PSEUDO_LABEL, (".png",)),
        )
    )
    label_set = None
    if (folder / "labels.json").exists():
        label_set = read_label_set(folder / "labels.json", notices)
    elif labels:
        notices.append("label/ is left out: labels.json, which names its classes, is missing")
    pictures: list[PosedPicture] = []
    for number, file in color.items():
        unsure = number not in depth and number in computed and number in sigma
        pictures.append(
            PosedPicture(
                file,
                lens,
                poses[number],
                stamps[number],
                depth_file=computed[number] if unsure else depth.get(number),
                sigma_file=sigma[number] if unsure else None,
                label_file=labels.get(number, pseudo.get(number)),
                pseudo_label=number not in labels,
                seq=number,
            )
        )
    source = f"folder {folder.resolve().name}"
    scale = given or DEPTH_SCALE
    scale_from = scale_from or ("" if given or not depth else f"depth of {scale}")
    return PosedPictures(
        source, pictures, options, scale, notices, scale_from=scale_from, hz=DEFAULT_HZ, labels=label_set
    )


def read_label_set(file: Path, notices: list[str] | None = None) -> LabelSet:
    """``labels.json`` -> label set; one that says nothing else is called as its folder.

    ``notices`` gets a sentence on what had to be assumed of the id that means unknown. Raises ImportSourceError:
    missing, or no label set.
    """
    labels = tables.convert_known(tables.read_plain_json(file), _Labels, file)
    try:
        label_set = _label_set(labels, file.resolve().parent.name)
    except (LabelError, ValueError) as error:
        raise ImportSourceError(f"{file}: {error}") from error
    if notices is not None and labels.ignore is None:
        notices.append(f"{file}: has no ignore id; {label_set.ignore_id}, which is no class, stands for unknown")
    if notices is not None and labels.ignore is msgspec.UNSET and "0" in labels.classes:
        notices.append(
            f"{file}: names no ignore id, so class 0 '{labels.classes['0']}' is read as unknown; where it is a class, "
            'write "ignore": null'
        )
    return label_set


def _label_set(labels: _Labels, folder_name: str) -> LabelSet:
    """Ids, names and colours of a recording; colours are those of a known set where it draws its ids from one."""
    if any(not 0 <= value <= 255 for color in labels.colors.values() for value in color):
        raise ValueError("colors must be three numbers of 0 to 255")
    classes = {int(key): name for key, name in labels.classes.items()}
    ignore_id = 0 if labels.ignore is msgspec.UNSET else labels.ignore
    if ignore_id is not None:
        classes.pop(ignore_id, None)
    ids = sorted(classes)
    name = labels.id_space.lower() or folder_name[:MAX_NAME]
    own = make_label_set(name, [classes[i] for i in ids], ids=ids, ignore_id=ignore_id)
    known = PROVIDED.get(name)
    chosen = {} if known is None else dict(zip(known.ids, known.colors, strict=True))
    chosen |= {int(key): color for key, color in labels.colors.items()}
    colors = tuple(chosen.get(i, color) for i, color in zip(ids, own.colors, strict=True))
    return LabelSet(own.name, own.ids, own.names, colors, own.ignore_id)


def read_intrinsics(
    file: Path, notices: list[str], pictures: Sequence[Path]
) -> tuple[CameraIntrinsics, DepthScale | None, str]:
    """``intrinsics.json`` -> intrinsics, the scale of depth images where given, and ``SCALE_UNKNOWN`` or "" of poses.

    The first of ``pictures`` that can be read tells the size where the file does not. ``notices`` gets a sentence on
    keys that are not read. Raises ImportSourceError: missing, or a value that cannot be.
    """
    plain = tables.read_plain_json(file)
    i = tables.convert_known(plain, _Intrinsics, file)
    tables.refuse_keys({key: value for key, value in plain.items() if key != "distortion"}, _OTHER_LENS, file)
    notices += tables.unknown_notice(file, [plain], _Intrinsics)
    if i.depth_scale is not None and i.depth_scale < 1:
        raise ImportSourceError(
            f"{file}: depth_scale {i.depth_scale:g} is no number of units per metre; where it is metres per unit, "
            f"write {1 / i.depth_scale:g}"
        )
    scale = DepthScale(i.depth_scale, file) if i.depth_scale is not None else None
    size = (i.width, i.height) if i.width and i.height else first_size(pictures, file)
    model = "fisheye" if i.fisheye else i.camera_model
    lens = camera_of(file, (i.fx, i.fy, i.cx, i.cy), size, model, i.distortion or ())
    return lens, scale, SCALE_UNKNOWN if i.scale == SCALE_UNKNOWN else ""
