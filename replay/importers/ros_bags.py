"""Files and messages of ROS bags: which files are bags, what their topics hold, and images as messages have them.

Files are known by their content: bags that were merged, renamed or packed have other names and profiles. Depth follows
REP 118: 16UC1 is millimetres with 0 for no measurement, 32FC1 is metres with NaN. ``compressedDepth`` is 12 bytes and a
PNG; of 32FC1 it holds the inverse depth, quantised.
"""

import re
import struct
import tempfile
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from semantic_mapper.errors import CodecError, ConfigError, ImportSourceError, SemanticMapperError
from semantic_mapper.files import open_regular
from semantic_mapper.plain_text import visible
from semantic_mapper.replay.importers.base import camera_of, metres
from semantic_mapper.transport.codec import EncodedImage
from semantic_mapper.transport.images import decode_image_file
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

_PACKED = (".zstd", ".zst")
_MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}  # what the two kinds of files begin with
LISTED = 12  # topics that an error names
LOOKED_AT = 100  # messages of a topic until one tells what it is
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSES = (
    *("nav_msgs/msg/Odometry", "geometry_msgs/msg/TransformStamped"),  # with the name of the frame that they are of
    *("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"),
)
_IMAGES = (("sensor_msgs/msg/Image", "encoding"), ("sensor_msgs/msg/CompressedImage", "format"))
_REPAIR = (
    "`ros2 bag reindex`, `mcap recover` or `rosbag reindex` repairs a bag whose recorder was killed; one that was "
    "copied in part has to be copied again"
)
UNITS_PER_M = 1000.0  # of 16-bit depth
# Encoding -> bytes a pixel, and what makes RGB of it; None = it is RGB.
COLOR_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    **dict.fromkeys(("bgr8", "8UC3"), (3, cv2.COLOR_BGR2RGB)),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    **dict.fromkeys(("bgra8", "8UC4"), (4, cv2.COLOR_BGRA2RGB)),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2RGB_YUY2)),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    **dict.fromkeys(("mono8", "8UC1"), (1, cv2.COLOR_GRAY2RGB)),
}
DEPTH_ENCODINGS = {"16UC1": np.dtype("<u2"), "mono16": np.dtype("<u2"), "32FC1": np.dtype("<f4")}
_MAX_SIDE = 1 << 14  # pixels
_COMPRESSED_DEPTH_HEAD = struct.Struct("<iff")  # format, and A and B of the quantised inverse depth


def is_bag(src: Path) -> bool:
    """Whether a file is a bag, or a folder is one of ROS 2, complete or without its metadata."""
    if src.is_dir():
        files = _storage_files(src)
        return bool(files) and ((src / "metadata.yaml").exists() or all(map(is_bag, files)))
    if src.suffix == ".mcap":
        return _ros_profile(src) is not None
    return src.suffix in (".bag", ".db3") or _packed_suffix(src) != ""  # one that is damaged is still a bag


def _storage_files(folder: Path) -> list[Path]:
    """Files of a folder that may be parts of a bag of ROS 2."""
    return sorted(f for f in folder.iterdir() if f.suffix in (".mcap", ".db3", *_PACKED))


def _packed_suffix(file: Path) -> str:
    """Suffix of the bag that a packed file holds; empty = it holds none."""
    if file.suffix not in _PACKED:
        return ""
    try:
        with open_regular(file) as source, zstandard.ZstdDecompressor().stream_reader(source) as packed:
            head = packed.read(max(map(len, _MAGIC)))
    except (OSError, ConfigError, zstandard.ZstdError):
        return ""
    return next((suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)), "")


def _ros_profile(file: Path) -> str | None:
    """The profile of an MCAP file: "ros2", or "" where `mcap merge` left it empty; None = it is no bag of ROS 2."""
    try:
        with open_regular(file) as source:
            reader = make_reader(source)
            profile = reader.get_header().profile
            if not profile:
                schema, _, _ = next(iter(reader.iter_messages()))
                profile = "" if schema is not None and schema.encoding in ("ros2msg", "ros2idl") else "other"
    except (OSError, ConfigError, McapError, StopIteration, ValueError, struct.error):
        return None
    return profile if profile in ("ros2", "") else None


def _readable(src: Path) -> tuple[list[Path], tempfile.TemporaryDirectory[str]]:
    """What rosbags is to open, and the folder of what had to be made for that."""
    folder = tempfile.TemporaryDirectory(prefix="semantic-mapper-bag-")
    whole = src.is_file() or (src / "metadata.yaml").exists()
    made: list[Path] = []
    for file in [src] if whole else _storage_files(src):
        unpacked = _unpacked(file, Path(folder.name)) if file.suffix in _PACKED else file
        empty = unpacked.suffix == ".mcap" and _ros_profile(unpacked) == ""
        made.append(_with_profile(unpacked, Path(folder.name)) if empty else unpacked)
    return made, folder


def _unpacked(file: Path, folder: Path) -> Path:
    path = (folder / file.stem).with_suffix(_packed_suffix(file))
    with file.open("rb") as packed, path.open("wb") as out:
        zstandard.ZstdDecompressor().copy_stream(packed, out)
    return path


def _with_profile(file: Path, folder: Path) -> Path:
    """The messages of a bag, written again with the profile that rosbags asks for."""
    path = folder / f"{file.stem}-ros2.mcap"
    written: dict[int, int] = {}  # number of each channel
    with file.open("rb") as source, path.open("wb") as out:
        writer = Writer(out)
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(source).iter_messages():
            if schema is None:
                continue
            if channel.id not in written:
                of = writer.register_schema(schema.name, schema.encoding, schema.data)
                metadata = {"offered_qos_profiles": "", **channel.metadata}
                written[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of, metadata)
            at = (message.log_time, message.data, message.publish_time, message.sequence)
            writer.add_message(written[channel.id], *at)
        writer.finish()
    return path


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of images."""

    name: str
    raw: bool  # ``sensor_msgs/Image``, not compressed
    encoding: str  # of its first message with data
    frame: str  # of the first message that names one

    @property
    def rectified(self) -> bool:
        """Whether its images have no lens distortion any more."""
        return re.search(r"(^|_)rect(_|$)|rectified", self.base.rsplit("/", 1)[-1]) is not None

    @property
    def base(self) -> str:
        """Name without the transport."""
        return self.name if self.raw else re.sub("/compressed(Depth)?$", "", self.name)

    @property
    def is_depth(self) -> bool:
        """Whether it shows depth; the name decides where the encoding leaves it open."""
        named = self._pixels == "mono16" and "depth" in self.name.lower()
        return "compressedDepth" in self.encoding or self._pixels in ("16UC1", "32FC1") or named

    @property
    def is_grey(self) -> bool:
        """Whether its images have no colour."""
        return self._pixels in ("mono8", "8UC1")

    @property
    def _pixels(self) -> str:
        return re.split("[; ]", self.encoding.strip())[0]

    def __str__(self) -> str:
        return f"{self.name} ({visible(self.encoding)})"


class Calibration:
    """A ``sensor_msgs/CameraInfo``: K (9,) and lens D of the raw image, P (12,) of the rectified one, R (3, 3)."""

    def __init__(self, info: Any) -> None:
        self.frame = frame_name(info.header.frame_id)
        self.size: tuple[int, int] = (info.width, info.height)
        self.model: str = info.distortion_model
        names = "KDRP" if hasattr(info, "K") else "kdrp"  # of ROS 1, and of ROS 2
        self.K, self.D, R, self.P = (np.asarray(getattr(info, name), np.float64) for name in names)
        self.R = R.reshape(3, 3)
        roi = info.roi
        cut = 0 < roi.width < info.width or 0 < roi.height < info.height or roi.x_offset or roi.y_offset
        self.whole = not cut and info.binning_x <= 1 and info.binning_y <= 1

    @property
    def says_something(self) -> bool:
        """Cameras send some before they know."""
        return bool((self.K.any() or self.P.any()) and all(np.isfinite(m).all() for m in (self.K, self.D, self.P)))

    def intrinsics(self, where: str, *, rectified: bool) -> CameraIntrinsics:
        """Of the raw image, or of one whose lens distortion has been removed already.

        Raises ImportSourceError: not calibrated, a lens model that is not OpenCV's, skew, binning or a region of
        interest.
        """
        rectified = rectified and bool(self.P.any() or self.D.any())  # a pinhole camera's driver may leave P empty
        K = (self.P if rectified else self.K).reshape(3, -1)
        k = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        for trouble, there in (
            ("binning or a region of interest", not self.whole),
            ("skew", K[0, 1] or K[1, 0]),
            (f"no calibration ({'P' if rectified else 'K'} is zero)", not k[0] or not k[1]),
        ):
            if there:
                raise ImportSourceError(f"{where} has {trouble}: calibrate the camera, and record whole images again")
        return camera_of(where, k, self.size, "" if rectified else self.model, () if rectified else self.D.tolist())


class Bag:
    """A bag that is open, by the names of its topics. Raises ImportSourceError: it cannot be read."""

    def __init__(self, src: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        with self._explained():
            paths, self._unpacked = _readable(src)  # what was made for it is there as long as this is
            # Bags of ROS 2 before Iron hold no definitions of their messages; those read here have not changed since.
            self._reader: Any = AnyReader(paths, default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        self._streams: dict[str, tuple[int, Iterator[tuple[Any, int, bytes]]]] = {}  # next index, and its messages

    def topics(self, *types: str) -> list[str]:
        """Names of topics of these types that have messages."""
        return sorted({c.topic for c in self._reader.connections if c.msgtype in types and c.msgcount})

    def listing(self) -> str:
        """All topics, for people."""
        names = sorted({f"{c.topic} ({c.msgtype.replace('/msg/', '/')})" for c in self._reader.connections})
        more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        return visible(", ".join(names[:LISTED])) + more if names else "no topic at all"

    def image_topics(self) -> list[Topic]:
        """Topics of images that have messages, by the first of them that tell what they are."""
        found: list[Topic] = []
        for kind, field in _IMAGES:
            for name in self.topics(kind):
                encoding = frame = ""
                for _, _, message, _ in islice(self.messages({name}), LOOKED_AT):
                    encoding = encoding or (str(getattr(message, field)) if len(message.data) else "")
                    frame = frame or frame_name(message.header.frame_id)
                    if encoding and frame:
                        break
                found.append(Topic(name, kind == _IMAGES[0][0], encoding, frame))
        return found

    def messages(self, names: set[str]) -> Iterator[tuple[str, int, Any, str]]:
        """Topic, time of recording, message, and its node (ROS 1; else empty), in the order of recording."""
        with self._explained():
            for connection, received_ns, data in self._reader.messages(connections=self._connections(names)):
                node = getattr(connection.ext, "callerid", None) or ""
                yield connection.topic, received_ns, self._reader.deserialize(data, connection.msgtype), node

    def message(self, name: str, received_ns: list[int], index: int) -> Any:
        """One message of a topic, quick where they are read in order; ``received_ns`` has the times of all of them.

        Raises CodecError: it cannot be read.
        """
        position, stream = self._streams.pop(name, (-1, iter(())))
        try:
            if not 0 <= position <= index:
                position = bisect_left(received_ns, received_ns[index])
                stream = iter(self._reader.messages(connections=self._connections({name}), start=received_ns[index]))
            with self._explained():
                connection, _, data = next(islice(stream, index - position, None))
                message = self._reader.deserialize(data, connection.msgtype)
        except (ImportSourceError, StopIteration) as error:
            raise CodecError(f"cannot be read: {error}") from error
        self._streams[name] = (index + 1, stream)
        return message

    def _connections(self, names: set[str]) -> list[Any]:
        return [c for c in self._reader.connections if c.topic in names]

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Make of whatever a damaged bag leads to an error that says what to do."""
        try:
            yield
        except (SemanticMapperError, StopIteration, MemoryError):
            raise
        except Exception as error:  # storage, compression and messages each raise their own
            raise ImportSourceError(
                f"this ROS bag cannot be read: {visible(str(error)) or type(error).__name__}; {_REPAIR}"
            ) from error


def frame_name(name: str) -> str:
    """As ROS 2 writes it: ROS 1 begins some names with a slash."""
    return name.lstrip("/")


def position_and_rotation(message: Any) -> tuple[Any, Any]:
    """Of a message of one of the types ``POSES``."""
    if hasattr(message, "transform"):
        return message.transform.translation, message.transform.rotation
    pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
    return pose.position, pose.orientation


def compressed_image(message: Any) -> tuple[UInt8, EncodedImage]:
    """RGB (H, W, 3) of a ``sensor_msgs/CompressedImage``, and its file. Raises CodecError: it is damaged."""
    data = message.data.tobytes()
    rgb, encoding = decode_image_file(data)
    return rgb, EncodedImage(encoding, data)


def color_image(message: Any) -> tuple[UInt8, None]:
    """RGB (H, W, 3) of a ``sensor_msgs/Image``; no file has it.

    Raises CodecError: another encoding, or fewer bytes than its size needs.
    """
    if message.encoding not in COLOR_ENCODINGS:
        raise CodecError(f"images of encoding '{message.encoding}' are not read, only {', '.join(COLOR_ENCODINGS)}")
    bytes_a_pixel, code = COLOR_ENCODINGS[message.encoding]
    rows = _rows(message, bytes_a_pixel)
    pixels = rows.reshape(message.height, message.width, bytes_a_pixel)
    try:
        return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8), None
    except cv2.error as error:
        raise CodecError(
            f"{message.encoding} of {message.width}x{message.height} is no image: {error.err or error}"
        ) from error


def depth_image(message: Any) -> Float32:
    """Depth (H, W) in metres of a ``sensor_msgs/Image``, 0 where nothing was measured.

    Raises CodecError: another encoding, or fewer bytes than its size needs.
    """
    if message.encoding not in DEPTH_ENCODINGS:
        known = ", ".join(DEPTH_ENCODINGS)
        raise CodecError(f"depth images of encoding '{message.encoding}' are not read, only {known}")
    kind = DEPTH_ENCODINGS[message.encoding]
    values = _rows(message, kind.itemsize).view(kind.newbyteorder(">") if message.is_bigendian else kind)
    return metres(values, UNITS_PER_M if values.dtype.kind == "u" else 1.0)


def compressed_depth_image(message: Any) -> Float32:
    """Depth (H, W) in metres of a ``sensor_msgs/CompressedImage`` of transport compressedDepth, or a 16-bit PNG.

    Raises CodecError: another compression than PNG, or damaged.
    """
    data = message.data.tobytes()
    quantised = None
    if "compressedDepth" in message.format:
        if len(data) <= _COMPRESSED_DEPTH_HEAD.size:
            raise CodecError(f"compressed depth of {len(data)} bytes holds no image")
        if "rvl" in message.format.lower():
            raise CodecError("depth compressed by RVL is not read: record it as PNG, or republish it raw")
        _, a, b = _COMPRESSED_DEPTH_HEAD.unpack_from(data)
        quantised = (a, b) if message.format.strip().startswith("32FC1") else None
        data = data[_COMPRESSED_DEPTH_HEAD.size :]
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise CodecError(f"the depth image is damaged: {error}") from error
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise CodecError(f"the depth image of format '{message.format}' is damaged, or no PNG of 16 bits")
    values = np.asarray(image, np.uint16)
    if quantised is None:
        return metres(values, UNITS_PER_M)
    a, b = quantised
    with np.errstate(divide="ignore", invalid="ignore"):
        return metres(np.where(values > 0, a / (values.astype(np.float32) - b), 0).astype(np.float32), 1.0)


def _rows(message: Any, bytes_a_pixel: int) -> UInt8:
    """The bytes of an image without padding, (H, W * bytes_a_pixel); raises CodecError."""
    height, width, step = message.height, message.width, message.step
    used = width * bytes_a_pixel
    if not (0 < height <= _MAX_SIDE and 0 < width <= _MAX_SIDE) or step < used or len(message.data) < height * step:
        raise CodecError(
            f"an image of {width}x{height} with {step} bytes a row does not fit into its {len(message.data)} bytes"
        )
    return np.ascontiguousarray(message.data[: height * step].reshape(height, step)[:, :used])
