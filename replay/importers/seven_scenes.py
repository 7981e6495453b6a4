"""7-Scenes as published: a sequence of a Kinect, such as ``chess/seq-01``.

Poses are those of the depth camera; depth of 65535 is no measurement. The data set gives a focal length of 585 and a
principal point of (320, 240) for depth, and nothing for colour. Those of the colour camera, and where it sits, are
estimated: edges of depth were brought onto edges of colour in one of its sequences. Depth is registered to colour, and
poses become those of the colour camera.
"""

from pathlib import Path

import numpy as np

from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.errors import ImportSourceError
from semantic_mapper.geometry import invert_pose, transform, unproject
from semantic_mapper.replay.importers.base import BadFrameError, DepthScale, ImportOptions, depth_of_points, read_depth
from semantic_mapper.replay.importers.posed import PosedPicture, PosedPictures
from semantic_mapper.replay.importers.tables import numbered_files, read_matrix, without_picture
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

_CALIBRATIONS = ("info.txt", "camera-intrinsics.txt")  # of other data sets in this layout
SCALE = DepthScale(1000.0, convention="7-Scenes' millimetres")
HZ = 30.0
_NO_DEPTH_M = 65.535
_DEPTH = CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
_COLOR = CameraIntrinsics(526.8, 526.8, 322.4, 237.2, 640, 480)
T_COLOR_DEPTH = np.array([[1.0, 0, 0, -0.0308], [0, 1, 0, 0.0042], [0, 0, 1, 0.0019], [0, 0, 0, 1]])


def open_seven_scenes(folder: Path, options: ImportOptions) -> PosedPictures:
    """A sequence, opened; one frame for each colour image. Raises ImportSourceError: none has a pose."""
    for file in (place / name for place in (folder, folder.parent) for name in _CALIBRATIONS):
        if file.exists():
            raise ImportSourceError(
                f"{file}: 7-Scenes has no such file; this is another data set in its layout, with a camera of its own. "
                "Rewrite it as a sequence folder: color/, depth/, poses.txt, intrinsics.json"
            )
    notices = ["the data set has no calibration of its colour camera: an estimate of it registers depth to colour"]
    color = numbered_files(folder, (".color.png", ".color.jpg"), notices)
    depth = numbered_files(folder, (".depth.png",), notices)
    poses = numbered_files(folder, (".pose.txt",), notices)
    notices += without_picture("pose", poses, color, folder)
    pictures = [
        PosedPicture(
            file,
            _COLOR,
            _pose(poses.get(number, folder / f"frame-{number:06d}.pose.txt")),
            round(number * 1e9 / HZ),
            depth_file=depth.get(number),
            seq=number,
        )
        for number, file in color.items()
    ]

    def registered(picture: PosedPicture, lens: Rectifier) -> Float32:
        assert picture.depth_file is not None
        depth_m = read_depth(picture.depth_file, SCALE)
        if depth_m.shape != (_DEPTH.height, _DEPTH.width):
            raise BadFrameError(
                picture.depth_file, f"is not {_DEPTH.width}x{_DEPTH.height}, as depth of the data set is"
            )
        depth_m[depth_m >= _NO_DEPTH_M] = 0
        points = unproject(depth_m, _DEPTH)[depth_m > 0]
        return depth_of_points(transform(T_COLOR_DEPTH, points), lens.intrinsics)

    source = f"7-scenes {folder.resolve().parent.name} {folder.resolve().name}"
    return PosedPictures(source, pictures, options, SCALE, notices, hz=HZ, read_depth=registered)


def _pose(file: Path) -> Float64 | BadFrameError:
    try:
        return read_matrix(file) @ invert_pose(T_COLOR_DEPTH)
    except BadFrameError as error:
        return error
