"""Where the images of a calibration come from, as the command line names it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import structlog

from semantic_mapper.errors import CameraError, ConfigError
from semantic_mapper.nodes.options import SOURCE_PATTERN

if TYPE_CHECKING:
    from semantic_mapper.drivers.base import Camera, CameraImage

SIDES = ("left", "right")  # of a stereo pair, as its cameras are called
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_ADDRESSES = {
    "v4l2": "device",
    "opencv": "source",
    "oak": "device",
    "realsense": "device",
}  # key of the driver's config
_KEEPS_INTRINSICS = ("oak", "realsense")  # rectifies with what its maker has measured

_log = structlog.get_logger(__name__)


class Source(Protocol):
    """Images of one camera or, of a log, of several."""

    live: bool
    stream: bool  # images follow each other closely
    known: bool  # the intrinsics that it tells are right

    def images(self) -> Iterator[tuple[str, CameraImage]]:
        """Images with what to call each, to the end; a live camera's until ``stop``."""
        ...

    def stop(self) -> None:
        """End ``images`` soon, from any thread."""
        ...


def check_places(texts: Sequence[str]) -> None:
    """Check that files and folders among the sources are there, before the packages that read them are loaded.

    Raises:
        ConfigError: one is not, or has no name for a camera.
    """
    for text in texts:
        _, place = _split(text, alone=len(texts) == 1)
        kind, colon, _ = place.partition(":")
        if not (colon and kind in _ADDRESSES) and not Path(place).is_file() and not Path(place).is_dir():
            raise ConfigError(
                f"{place}: neither a folder of pictures, a log (.mcap) or video that is there, nor a camera as "
                f"KIND:ADDRESS with a kind of {', '.join(_ADDRESSES)} (`semantic-mapper doctor --cameras` lists them)"
            )


def parse_sources(texts: Sequence[str], size: str) -> list[Source]:
    """Sources as ``[NAME=]PLACE``, see ``calibrate``.

    Args:
        texts: Of the command line.
        size: "WIDTHxHEIGHT" to ask of V4L2 cameras; empty = as they are.

    Raises:
        ConfigError: not a place, no name for a camera, or two cameras of one name.
        CameraError, DependencyError: a camera that cannot be opened.
    """
    named = [_split(text, alone=len(texts) == 1) for text in texts]
    folders = [(name, Path(place)) for name, place in named if Path(place).is_dir()]
    stems = sorted({f.stem for _, folder in folders for f in _pictures(folder)})
    found: list[Source] = []
    names: list[str] = []
    for name, place in named:
        if Path(place).is_dir():
            found.append(_Folder(name, Path(place), stems))
        elif place.endswith(".mcap"):
            found.append(_Log(Path(place)))
            continue  # names its cameras itself
        else:
            found.append(_camera_source(name, place, size))
        names.append(name)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"two cameras are called '{twice[0]}'; name them: left={named[0][1]} right={named[1][1]}")
    return found


def parse_stereo(texts: Sequence[str], size: str) -> tuple[str, Source]:
    """The source of a stereo pair that gives both images side by side, as ``[NAME=]PLACE``: its name, and its halves
    as two cameras, left and right.

    Args:
        texts: Of the command line.
        size: "WIDTHxHEIGHT" of both together, to ask of V4L2 cameras; empty = as they are.

    Raises:
        ConfigError: more than one, or not a place.
        CameraError, DependencyError: a camera that cannot be opened.
    """
    if len(texts) != 1:
        raise ConfigError("--stereo calibrates one device that gives both images side by side; name one")
    name, _ = _split(texts[0], alone=True)
    (source,) = parse_sources(texts, size)
    return ("stereo" if name == "camera" else name), _Halves(source)


def _split(text: str, *, alone: bool) -> tuple[str, str]:
    name, equals, place = text.partition("=")
    if not equals or "/" in name or ":" in name:
        name, place = "", text
    name = name or ("camera" if alone else re.sub(r"[^A-Za-z0-9_.-]", "-", Path(place).stem) or "camera")
    if not re.match(SOURCE_PATTERN, name):
        raise ConfigError(f"'{name}' cannot be the name of a camera: use letters, digits and any of _ . -")
    return name, place


def _camera_source(name: str, place: str, size: str) -> Source:
    from semantic_mapper.drivers.registry import open_camera

    kind, colon, address = place.partition(":")
    if colon and kind in _ADDRESSES:
        config: dict[str, Any] = {_ADDRESSES[kind]: address}
        if kind not in _KEEPS_INTRINSICS:
            config["uncalibrated"] = True
        if size and kind == "v4l2":
            config["width"], config["height"] = _read_size(size)
        live = kind != "opencv" or "://" in address
        camera = open_camera(kind, config, name, place)
        return _Camera(camera, live=live, known=kind in _KEEPS_INTRINSICS)
    check_places([place])
    plain = {"source": place, "uncalibrated": True, "pace": "fast"}
    return _Camera(open_camera("opencv", plain, name, place), live=False, known=False)


def _read_size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text)
    if found is None:
        raise ConfigError(f"--size {text:.40}: write WIDTHxHEIGHT, such as 1280x720")
    return int(found[1]), int(found[2])


def _pictures(folder: Path) -> list[Path]:
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in PICTURES)


@dataclass(slots=True)
class _Folder:
    """Pictures; those of one name in several folders were taken at once."""

    name: str
    folder: Path
    stems: Sequence[str]  # of all folders
    live: bool = False
    stream: bool = False
    known: bool = False

    def images(self) -> Iterator[tuple[str, CameraImage]]:
        import cv2
        import numpy as np

        from semantic_mapper.drivers.base import CameraImage
        from semantic_mapper.drivers.calibration import guess_intrinsics

        pictures = _pictures(self.folder)
        if not pictures:
            raise CameraError(f"{self.folder}: no pictures in it ({', '.join(PICTURES)})")
        for seq, path in enumerate(pictures):
            bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
            if bgr is None:
                raise CameraError(f"{path}: is no picture that OpenCV can read; take it out of the folder")
            rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
            stamp_ns = self.stems.index(path.stem) * 1_000_000_000
            plain = guess_intrinsics(rgb.shape[1], rgb.shape[0])
            yield path.name, CameraImage(stamp_ns, seq, self.name, rgb, None, plain)

    def stop(self) -> None:
        pass


@dataclass(slots=True)
class _Camera:
    """A live camera or a video."""

    camera: Camera
    live: bool
    known: bool
    stream: bool = True

    def images(self) -> Iterator[tuple[str, CameraImage]]:
        with self.camera as camera:
            for image in camera:
                yield f"image {image.seq}", image

    def stop(self) -> None:
        self.camera.stop()


class _Halves:
    """The images of a device that gives two side by side, as those of two cameras."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.live = source.live
        self.stream = source.stream
        self.known = False

    def images(self) -> Iterator[tuple[str, CameraImage]]:
        from semantic_mapper.drivers.base import CameraImage
        from semantic_mapper.drivers.calibration import guess_intrinsics
        from semantic_mapper.drivers.stereo.camera import halves

        for name, image in self._source.images():
            for side, rgb in zip(SIDES, halves(image.rgb), strict=True):
                plain = guess_intrinsics(rgb.shape[1], rgb.shape[0])
                yield name, CameraImage(image.stamp_ns, image.seq, side, rgb, None, plain)

    def stop(self) -> None:
        self._source.stop()


@dataclass(slots=True)
class _Log:
    """The images of a log."""

    path: Path
    live: bool = False
    stream: bool = True
    known: bool = False

    def images(self) -> Iterator[tuple[str, CameraImage]]:
        from semantic_mapper.drivers.base import CameraImage
        from semantic_mapper.replay.log.sequence import open_log

        # What comes of it is right for the log's images; the camera's own are another matter.
        _log.warning(
            "log_is_rectified", log=str(self.path), mend="calibrate the lens from the camera itself or a video"
        )
        with open_log(self.path) as log:
            for frame in log:
                image = CameraImage(frame.stamp_ns, frame.seq, frame.camera_id, frame.rgb, None, frame.intrinsics)
                yield f"frame {frame.seq}", image

    def stop(self) -> None:
        pass
