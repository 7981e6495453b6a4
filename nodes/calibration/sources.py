"""Views of the board from all sources, as the command line names them: recorded ones in turn, live ones at once."""

import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import structlog

from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibrating.rig import MIN_INSTANTS
from semantic_mapper.drivers.calibrating.views import CalibrationConfig, ViewGatherer, simultaneous
from semantic_mapper.drivers.calibration import SIDES, guess_intrinsics
from semantic_mapper.drivers.poses.config import BoardPoses
from semantic_mapper.drivers.registry import open_camera
from semantic_mapper.drivers.stereo.camera import halves
from semantic_mapper.errors import CameraError, ConfigError
from semantic_mapper.nodes.options import SOURCE_PATTERN
from semantic_mapper.nodes.process import StopRequest
from semantic_mapper.replay.log.sequence import open_log

REPORT_S = 2.0
SPARE_INSTANTS = 4  # live rigs: beyond those needed
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_ADDRESSES = {"v4l2": "device", "opencv": "source", "oak": "device", "realsense": "device"}  # in the driver's config
_KEEPS_INTRINSICS = ("oak", "realsense")  # rectifies with what its maker has measured

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Source:
    """Images of one camera or, of a log, of several."""

    name: str  # of the camera; a log names its cameras itself
    # gives them with what to call each, to the end; a live camera's until ``stop``
    images: Callable[[], Iterator[tuple[str, CameraImage]]]
    live: bool = False  # it has no end
    stream: bool = True  # its images follow each other closely
    known: bool = False  # the intrinsics that it gives are right
    stop: Callable[[], None] = lambda: None  # ends ``images`` soon, from any thread


def parse_sources(texts: Sequence[str], size: str, *, stereo: bool = False) -> list[Source]:
    """Sources as ``[NAME=]PLACE``, see ``calibrate``; ``size`` as "WIDTHxHEIGHT" to ask of V4L2 cameras, or empty.

    With ``stereo`` a single one that gives the images of two cameras side by side (``size``: of both together).

    Raises ConfigError: not a place, no name for a camera, or two cameras of one name. CameraError, DependencyError: a
    camera that cannot be opened.
    """
    if stereo and len(texts) != 1:
        raise ConfigError("--stereo calibrates one device that gives both images side by side; name one")
    alone = ("stereo" if stereo else "camera") if len(texts) == 1 else ""
    named = [_split(text, alone) for text in texts]
    names = [name for name, place in named if not place.endswith(".mcap")]
    if len(set(names)) < len(names):
        raise ConfigError(f"two cameras have one name in {', '.join(names)}; write NAME=PLACE")
    stems = sorted({file.stem for _, place in named if Path(place).is_dir() for file in _pictures(Path(place))})
    found: list[Source] = []
    for name, place in named:
        if Path(place).is_dir():
            found.append(Source(name, partial(_folder_images, name, Path(place), stems), stream=False))
        elif place.endswith(".mcap"):
            found.append(Source(name, partial(_log_images, Path(place))))
        else:
            found.append(_camera_source(name, place, size))
    return [replace(s, images=partial(_halves, s), known=False) for s in found] if stereo else found


def _split(text: str, alone: str) -> tuple[str, str]:
    name, equals, place = text.partition("=")
    if not equals or "/" in name or ":" in name:
        name, place = "", text
    name = name or alone or re.sub(r"[^A-Za-z0-9_.-]", "-", Path(place).stem) or "camera"
    if not re.match(SOURCE_PATTERN, name):
        raise ConfigError(f"'{name}' cannot be the name of a camera: use letters, digits and any of _ . -")
    return name, place


def _camera_source(name: str, place: str, size: str) -> Source:
    kind, colon, address = place.partition(":")
    if not colon or kind not in _ADDRESSES:
        if not Path(place).is_file():
            raise ConfigError(
                f"{place}: neither a folder of pictures, a log (.mcap) or video that is there, nor a camera as "
                f"KIND:ADDRESS with a kind of {', '.join(_ADDRESSES)} (`semantic-mapper doctor --cameras` lists them)"
            )
        kind, address = "opencv", place
    known = kind in _KEEPS_INTRINSICS
    config: dict[str, Any] = {_ADDRESSES[kind]: address} | ({} if known else {"uncalibrated": True})
    if kind == "opencv":
        config["pace"] = "fast"
    if size and kind == "v4l2":
        found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", size)
        if found is None:
            raise ConfigError(f"--size {size:.40}: write WIDTHxHEIGHT, such as 1280x720")
        config["width"], config["height"] = int(found[1]), int(found[2])
    camera = open_camera(kind, config, name, place)
    return Source(name, partial(_camera_images, camera), live=not camera.can_wait, known=known, stop=camera.stop)


def _pictures(folder: Path) -> list[Path]:
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in PICTURES)


def _folder_images(name: str, folder: Path, stems: Sequence[str]) -> Iterator[tuple[str, CameraImage]]:
    """Pictures; those of one stem in several folders were taken at once (``stems``: of all folders)."""
    pictures = _pictures(folder)
    if not pictures:
        raise CameraError(f"{folder}: no pictures in it ({', '.join(PICTURES)})")
    for seq, path in enumerate(pictures):
        bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if bgr is None:
            raise CameraError(f"{path}: is no picture that OpenCV can read; take it out of the folder")
        rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
        stamp_ns = stems.index(path.stem) * 1_000_000_000
        yield path.name, CameraImage(stamp_ns, seq, name, rgb, None, guess_intrinsics(rgb.shape[1], rgb.shape[0]))


def _camera_images(camera: Camera) -> Iterator[tuple[str, CameraImage]]:
    with camera:
        for image in camera:
            yield f"image {image.seq}", image


def _halves(source: Source) -> Iterator[tuple[str, CameraImage]]:
    """The images of a device that gives two side by side, as those of two cameras."""
    for name, image in source.images():
        for side, rgb in zip(SIDES, halves(image.rgb), strict=True):
            plain = guess_intrinsics(rgb.shape[1], rgb.shape[0])
            yield name, CameraImage(image.stamp_ns, image.seq, side, rgb, None, plain)


def _log_images(path: Path) -> Iterator[tuple[str, CameraImage]]:
    # What comes of it is right for the log's images; the camera's own are another matter.
    _log.warning("log_is_rectified", log=str(path), fix="calibrate the lens from the camera itself or a video")
    with open_log(path) as log:
        for frame in log:
            image = CameraImage(frame.stamp_ns, frame.seq, frame.camera_id, frame.rgb, None, frame.intrinsics)
            yield f"frame {frame.seq}", image


class Gathering:
    """The views of all cameras."""

    def __init__(self, board: BoardPoses, config: CalibrationConfig) -> None:
        self.cameras: dict[str, ViewGatherer] = {}  # by name, in the order in which they came
        self.known: set[str] = set()  # cameras whose intrinsics are right as given
        self._board = board
        self._config = config
        self._mutex = threading.Lock()

    def run(self, sources: Sequence[Source], stop: StopRequest, seconds: float, *, rig: bool) -> None:
        """Take in all images; of live cameras, until there is enough of them, the time is over, or a stop request.

        Raises CameraError, LogError: a source fails.
        """
        live = [source for source in sources if source.live]
        recorded = [source for source in sources if not source.live]
        deadline = time.monotonic() + seconds
        with ThreadPoolExecutor(len(live) + 1) as pool:
            work = [pool.submit(self._take_all, part, stop) for part in (recorded, *([source] for source in live))]
            while not stop and not (live and time.monotonic() > deadline):
                done, going = wait(work, REPORT_S, FIRST_EXCEPTION)
                lacks = self.lacks(rig=rig) if len(self.cameras) >= len(sources) else ["waiting for images"]
                kept = {name: len(views.kept) for name, views in list(self.cameras.items())}
                _log.info("views", **kept, lacking="; ".join(lacks) or "nothing")
                if not going or (live and not lacks) or any(each.exception() for each in done):
                    break
            for source in live:
                source.stop()
        for each in work:
            each.result()

    def lacks(self, *, rig: bool) -> list[str]:
        """What is still missing, as sentences with the camera's name."""
        cameras = dict(self.cameras)
        lacks = [f"{name}: {lack}" for name, views in cameras.items() for lack in views.lacks()]
        shared, needed = (
            len(simultaneous({n: list(v.steady) for n, v in cameras.items()})),
            MIN_INSTANTS + SPARE_INSTANTS,
        )
        if rig and shared < needed:
            lacks.append(f"{shared} moments at which several cameras saw the board held still; {needed} are awaited")
        return lacks

    def _take_all(self, sources: Sequence[Source], stop: StopRequest) -> None:
        for source in sources:
            for name, image in source.images():
                self._camera(image.camera_id, source).take(image, name)
                if stop:
                    return

    def _camera(self, camera_id: str, source: Source) -> ViewGatherer:
        with self._mutex:
            if camera_id not in self.cameras:
                self.cameras[camera_id] = ViewGatherer(self._board, self._config, stream=source.stream)
                if source.known:
                    self.known.add(camera_id)
            return self.cameras[camera_id]
