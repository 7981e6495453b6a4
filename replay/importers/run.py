"""Any foreign recording -> log: choose the importer, write what is good, report what is not."""

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from semantic_mapper.config import nearest_path
from semantic_mapper.errors import CodecError, FrameError, ImportSourceError, LogError
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.autolabel_note import AUTOLABEL_ATTACHMENT, read_note
from semantic_mapper.replay.importers.base import BadFrameError, ImportOptions, ImportReport, Skipped, read_bytes
from semantic_mapper.replay.importers.folder import open_folder
from semantic_mapper.replay.importers.kitti360 import open_kitti360
from semantic_mapper.replay.importers.models import find_opensfm, open_colmap, open_opensfm
from semantic_mapper.replay.importers.phones import open_polycam, open_record3d
from semantic_mapper.replay.importers.posed import PosedPictures
from semantic_mapper.replay.importers.rooms import open_nice_slam, open_replica, open_scannet
from semantic_mapper.replay.importers.ros_bags import is_bag
from semantic_mapper.replay.importers.rosbag import open_rosbag
from semantic_mapper.replay.importers.seven_scenes import open_seven_scenes
from semantic_mapper.replay.importers.transforms import open_transforms
from semantic_mapper.replay.importers.tum import open_icl, open_tum
from semantic_mapper.replay.log.format import LogReader, atomic_log
from semantic_mapper.replay.log.reader import LogAttachment
from semantic_mapper.replay.run_folder import LOG_SUFFIX, is_log
from semantic_mapper.replay.sfm.colmap import find_models
from semantic_mapper.replay.sfm.film import PICTURE_SUFFIXES
from semantic_mapper.transport.images import CodecOptions

Format = Literal[
    "folder", "tum", "icl", "scannet", "replica", "nice-slam", "7-scenes", "kitti360", "rosbag", "polycam", "record3d",
    "transforms", "colmap", "opensfm",
]  # fmt: skip
FORMATS: dict[Format, Callable[[Path, ImportOptions], PosedPictures]] = {  # layouts.toml shows the files of each
    "folder": open_folder,
    "tum": open_tum,
    "icl": open_icl,
    "scannet": open_scannet,
    "replica": open_replica,
    "nice-slam": open_nice_slam,
    "7-scenes": open_seven_scenes,
    "kitti360": open_kitti360,
    "rosbag": open_rosbag,
    "polycam": open_polycam,
    "record3d": open_record3d,
    "transforms": open_transforms,
    "colmap": open_colmap,
    "opensfm": open_opensfm,
}

# What a folder of each format has, and no other. The other formats are known by what is in their files.
MARKS = {
    "folder": ("color", "poses.txt", "intrinsics.json"),
    "icl": ("associations.txt", "*.gt.freiburg"),  # before TUM, whose lists programs write next to them
    "tum": ("rgb.txt", "groundtruth.txt"),
    "scannet": ("color", "depth", "pose"),
    "replica": ("rgb", "depth", "traj_w_c.txt"),
    "nice-slam": ("results", "traj.txt"),
    "7-scenes": ("frame-*.color.png", "frame-*.pose.txt"),
    "kitti360": ("calibration/perspective.txt", "data_2d_raw", "data_poses"),
    "polycam": ("keyframes",),
    "record3d": ("rgb", "metadata.json"),
    "transforms": ("transforms.json",),
}

SCALED = ("transforms", "colmap", "opensfm")  # formats whose poses have a unit of their own
_SHOWN = "; docs/layouts.md shows the files of each format"
LISTED = 5  # recordings, or folders of pictures, that an error names
_VIDEO = "is a film, which has no poses: `semantic-mapper import` and `semantic-mapper map` find them"
_PACKED = "is packed; unpack it, and name the folder that comes out"
_FILES = {
    **dict.fromkeys((".mp4", ".avi", ".mkv", ".mov", ".webm"), _VIDEO),
    ".r3d": "is Record3D's own file; export it on the phone as 'EXR + RGB', and name the folder that comes out",
    ".sens": "is ScanNet's packed scan; unpack it by the data set's SensReader (color, depth, pose, intrinsic), and "
    "name the folder that comes out",
    **dict.fromkeys((".svo", ".svo2", ".klg"), "holds no poses; record a bag, or colour and depth with poses"),
    **dict.fromkeys((".zip", ".tgz", ".gz", ".tar", ".7z"), _PACKED),
}
# What folders hold that are nearly a recording.
_FOLDERS = {
    "transforms_train.json": "has its frames in transforms_train.json, _val and _test; put those that are wanted into "
    "one transforms.json",
    "associations.txt": "has associations.txt, but neither ICL-NUIM's *.gt.freiburg nor TUM's rgb.txt",
    "rgbd": "is Record3D's own format, unpacked; export it on the phone as 'EXR + RGB'",
    "traj.txt": "has traj.txt, as rooms of Replica that NICE-SLAM renders, but no results/",
    "map.npz": "holds the results of a run; name its log, or the recording that it was made of",
    "database.db": "has COLMAP's database, but no model; run the mapper, and name the folder that holds sparse/",
}

_DEFAULTS = ImportOptions()


def detect_format(src: Path) -> str:
    """Format of a recording by its file, or by the files in its folder.

    Raises ImportSourceError: no such file or folder, or none of the formats.
    """
    if not src.exists():
        raise ImportSourceError(f"{src}: no such file or folder{nearest_path(src)}")
    if is_bag(src):
        return "rosbag"
    if src.is_file():
        raise ImportSourceError(f"{src}: {_what_file(src)}")
    if not src.is_dir():
        raise ImportSourceError(f"{src}: is neither a file nor a folder; copy its content to one")
    name = _by_marks(src)
    if name is not None:
        return name
    if find_models(src):
        return "colmap"
    if find_opensfm(src) is not None:
        return "opensfm"
    if src.resolve().parent.name == "data_2d_raw":
        return "kitti360"
    raise ImportSourceError(f"{src}: {_what_folder(src)}")


def needs_import(src: Path) -> bool:
    """Whether a source is no log, though it may end as logs do: bags of ROS 2 are MCAP files, too, and the log of a
    recording may lie in the recording's folder."""
    return not is_log(src) or is_bag(src) or (src.is_dir() and _by_marks(src) is not None)


def is_recording(src: Path) -> bool:
    """Whether a folder is, or holds, a recording of one of the formats, or one that nearly is and gets advice."""
    try:
        detect_format(src)
    except ImportSourceError:
        nearly = any((src / name).exists() for name in _FOLDERS if name != "database.db")  # pictures, still
        return nearly or bool(_recordings_in(src))
    return True


def _find_recording(src: Path) -> tuple[Path, str]:
    """A recording, or the only one in a folder, and its format. Raises ImportSourceError: see ``detect_format``."""
    try:
        return src, detect_format(src)
    except ImportSourceError:
        inside = _recordings_in(src) if src.is_dir() and not any((src / name).exists() for name in _FOLDERS) else []
        if len(inside) != 1:
            raise
        return inside[0], detect_format(inside[0])


def _recordings_in(folder: Path) -> list[Path]:
    return [p for p in sorted(folder.iterdir()) if is_bag(p) or (p.is_dir() and _by_marks(p) is not None)]


def _by_marks(src: Path) -> str | None:
    return next((name for name in MARKS if not _lacks(src, name)), None)


def _lacks(src: Path, name: str) -> list[str]:
    """Files and folders of a format that a folder does not have."""
    return [mark for mark in MARKS[name] if next(src.glob(mark), None) is None]


def _what_folder(src: Path) -> str:
    advice = next((_FOLDERS[name] for name in _FOLDERS if (src / name).exists()), None)
    if advice is not None:
        return advice
    if below := _recordings_in(src) or [p for folder in sorted(src.glob("*/")) for p in _recordings_in(folder)]:
        return _name_one("recordings", below)
    name = min(MARKS, key=lambda n: len(_lacks(src, n)))
    if len(_lacks(src, name)) < len(MARKS[name]):
        return f"is nearest to a recording of format '{name}', but lacks {', '.join(_lacks(src, name))}{_SHOWN}"
    files = [*src.glob("*/*"), *src.glob("*/*/*")]
    first = {file.parent: file for file in sorted(files, reverse=True) if file.suffix.lower() in PICTURE_SUFFIXES}
    if films := sorted(folder for folder, file in first.items() if not _is_depth(file)):
        if len(films) == len(first):
            return _name_one("folders of pictures", films)
        depth = ", ".join(str(folder) for folder in sorted(first) if folder not in films)
        return f"holds depth ({depth}), but has no layout that is known{_SHOWN}; {films[0]} alone is a film"
    return f"is no recording of a known format ({', '.join(FORMATS)}){_SHOWN}"


def _is_depth(picture: Path) -> bool:
    image = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    return image is not None and image.dtype == np.uint16


def _name_one(what: str, places: Sequence[Path]) -> str:
    named = ", ".join(map(str, places[:LISTED]))
    return f"holds {what}; name one of them: {named} (`semantic-mapper map {shlex.quote(str(places[0]))}`)"


def _what_file(src: Path) -> str:
    if src.suffix.lower() in _FILES:
        return _FILES[src.suffix.lower()]
    if src.suffix != LOG_SUFFIX:
        return f"is a file, not the folder of a recording; the folder is perhaps {src.parent}"
    try:
        LogReader(src, allow_empty=True).close()
    except LogError:
        return (
            "is neither a bag of ROS 2 (none of its schemas is ros2msg or ros2idl) nor a log of semantic-mapper; other "
            "MCAP files, such as those that `export` has written for Foxglove, cannot be imported: use the log that "
            "they were made of, or convert bags of ROS 1 in MCAP with rosbags-convert"
        )
    return "is a log already; replay it as it is"


def import_recording(
    src: Path,
    dst: Path,
    format_name: str | None = None,
    on_progress: Callable[[int, int], None] | None = None,
    *,
    options: ImportOptions = _DEFAULTS,
    overwrite: bool = False,
) -> ImportReport:
    """Write the recording ``src`` (folder or ROS bag) to the log ``dst``, which is there once the import is complete.

    Images that are JPEG or PNG files stay what they are, and depth loses nothing. A frame that cannot be used is left
    out and reported; a bad label image costs the frame its label only. Raises ImportSourceError: not such a recording,
    or not one good frame in it. LabelError: a class to rename that the recording does not have. LogError: ``dst`` is
    there already, or cannot be written. The format is found out where ``format_name``, one of ``FORMATS``, is None;
    ``on_progress`` is called with (frames looked at, frames in all).
    """
    if dst.exists() and not overwrite:
        raise LogError(f"{dst}: exists already; choose another name, or --overwrite it")
    given = src
    src, name = (src, format_name) if format_name else _find_recording(src)
    if name not in FORMATS:
        raise ImportSourceError(f"no format '{name}'; there are {', '.join(FORMATS)}")
    if options.scale is not None and name not in SCALED:
        raise ImportSourceError(f"{src}: poses of format '{name}' are in metres; --scale is for {', '.join(SCALED)}")
    if not src.is_dir() and not (name == "rosbag" and src.is_file()):
        raise ImportSourceError(f"{src}: no such folder")
    recording = FORMATS[name](src, options)
    numbers = range(0, len(recording), options.every)[: options.max_frames]
    if src != given:
        recording.notices.insert(0, f"the recording is {src}, the only one in {given}")
    report = ImportReport(name, recording.depth_scale, recording.info, notices=recording.notices)
    pseudo_labelled = computed = 0
    packing = CodecOptions(depth_scale=recording.depth_scale.units_per_m)
    with atomic_log(dst, recording.info, options=packing, overwrite=overwrite) as writer:
        if name == "folder" and (src / AUTOLABEL_ATTACHMENT).is_file():
            # Who rendered its pseudo labels, and from which frames' labels: these must not be scored.
            note = LogAttachment(AUTOLABEL_ATTACHMENT, "application/json", read_bytes(src / AUTOLABEL_ATTACHMENT))
            if read_note({note.name: note}) is None:
                raise ImportSourceError(f"{src}: {note.name} does not say who rendered the pseudo labels; export again")
            writer.attach(note)
        for done, number in enumerate(numbers, 1):
            try:
                loaded = recording.load(number)
                writer.write_frame(loaded.frame, encoded_rgb=loaded.encoded_rgb)
            except BadFrameError as error:
                report.skipped.append(Skipped(error.file, error.reason, number))
            except (FrameError, CodecError) as error:
                report.skipped.append(Skipped(Path(f"frame {number}"), str(error), number))
            else:
                report.count(loaded.frame)
                pseudo_labelled += loaded.frame.label_is_pseudo
                computed += loaded.frame.depth_sigma_m is not None
                if (bad := loaded.label_error) is not None:
                    report.skipped.append(Skipped(bad.file, bad.reason, number, label_only=True))
            if on_progress is not None:
                on_progress(done, len(numbers))
        if not report.frames:
            first_of_each = {s.reason: f"{s.file}: {s.reason}" for s in reversed(report.skipped)}
            reasons = "; ".join(list(first_of_each.values())[::-1][:3])
            raise ImportSourceError(f"{src}: none of its {len(numbers)} frames can be used: {reasons}")
    for count, what in ((pseudo_labelled, "pseudo labels, which weights have rendered"), (computed, "computed depth")):
        if count:
            report.notices.append(f"{counted(count, 'frame')} with {what}; marked in the log")
    report.bytes = dst.stat().st_size
    return report
