"""Files of ROS bags, known by their content: bags that were merged, renamed or packed have other names and profiles."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Literal

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer

from semantic_mapper.errors import ConfigError, ImportSourceError
from semantic_mapper.files import open_regular

BagKind = Literal["bag", "db3", "mcap", "zstd"]
_SUFFIXES = (".mcap", ".db3", ".zstd", ".zst")  # of the files in a folder of ROS 2
_HEAD_BYTES = 1 << 15
_ROS2_SCHEMAS = ("ros2msg", "ros2idl")


def bag_kind(path: Path) -> BagKind | None:
    """What a file is: a bag of ROS 1, storage of ROS 2 (SQLite, MCAP), or one that zstd has packed; None = no bag."""
    head = _head(path)
    kind = _kind_of(head)
    if kind == "mcap":
        return "mcap" if _holds_ros2(path, head) else None
    if kind == "zstd":
        try:
            with path.open("rb") as file, zstandard.ZstdDecompressor().stream_reader(file) as packed:
                return "zstd" if _kind_of(packed.read(_HEAD_BYTES)) in ("db3", "mcap") else None
        except (OSError, zstandard.ZstdError):
            return None
    return kind


def _head(path: Path) -> bytes:
    """The first bytes of a file; none where it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read(_HEAD_BYTES)
    except (OSError, ConfigError):
        return b""


def _profile(head: bytes) -> bytes:
    """That of an MCAP file: after magic, op code, and the lengths of the record and of it."""
    return head[21 : 21 + int.from_bytes(head[17:21], "little")]


def _kind_of(head: bytes) -> BagKind | None:
    if head.startswith(b"#ROSBAG V2.0"):
        return "bag"
    if head.startswith(b"SQLite format 3\0"):
        return "db3" if b"topics" in head and b"messages" in head else None
    if head.startswith(b"\x89MCAP0\r\n"):
        return "mcap"
    return "zstd" if head.startswith(b"\x28\xb5\x2f\xfd") else None


def _holds_ros2(path: Path, head: bytes) -> bool:
    """Whether an MCAP file is a bag of ROS 2: by its profile, or, where `mcap merge` left it empty, by its schemas."""
    if _profile(head):
        return _profile(head) == b"ros2"
    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is not None and summary.schemas:
                return any(schema.encoding in _ROS2_SCHEMAS for schema in summary.schemas.values())
            schema, _, _ = next(iter(reader.iter_messages()))
            return schema is not None and schema.encoding in _ROS2_SCHEMAS
    except (OSError, McapError, StopIteration, ValueError):
        return False


def storage_files(folder: Path) -> list[Path]:
    """Files of a folder that may be parts of a bag of ROS 2."""
    return sorted(f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES) if folder.is_dir() else []


def is_bag(src: Path) -> bool:
    """Whether a file is a bag, or a folder is one of ROS 2, complete or without its metadata."""
    if not src.is_dir():
        return src.suffix in (".bag", ".db3") or bag_kind(src) is not None  # a bag that is damaged is still one
    files = storage_files(src)
    return bool(files) and ((src / "metadata.yaml").exists() or all(bag_kind(file) is not None for file in files))


def readable_bag(src: Path) -> tuple[list[Path], tempfile.TemporaryDirectory[str] | None]:
    """What rosbags, which goes by suffixes, is to open, and the folder of what had to be made for that.

    Raises:
        ImportSourceError: a packed file is damaged.
    """
    if src.is_dir() and (src / "metadata.yaml").exists():
        return [src], None
    files = [src] if src.is_file() else storage_files(src)
    kinds = [bag_kind(file) for file in files]
    bare = [kind == "mcap" and not _profile(_head(file)) for file, kind in zip(files, kinds, strict=True)]
    named = [kind is None or file.suffix == f".{kind}" for file, kind in zip(files, kinds, strict=True)]
    if all(named) and not any(bare) and "zstd" not in kinds:
        return files, None
    folder = tempfile.TemporaryDirectory(prefix="semantic-mapper-bag-")
    made: list[Path] = []
    for file, kind, without_profile in zip(files, kinds, bare, strict=True):
        path = Path(folder.name) / f"{file.stem}.{kind}"
        if kind == "zstd":
            path = _unpacked(file, Path(folder.name))
        elif without_profile:
            _with_profile(file, path)
        else:
            path.symlink_to(file.resolve())
        made.append(path)
    return made, folder


def _with_profile(file: Path, path: Path) -> None:
    """Write the messages of a bag again, with the profile that rosbags asks for."""
    try:
        with file.open("rb") as source, path.open("wb") as out:
            writer = Writer(out)
            writer.start(profile="ros2")
            schemas: dict[int, int] = {}
            channels: dict[int, int] = {}
            for schema, channel, message in make_reader(source).iter_messages():
                if schema is not None and schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                if channel.id not in channels:
                    of = schemas.get(schema.id, 0) if schema is not None else 0
                    metadata = {"offered_qos_profiles": "", **channel.metadata}
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, of, metadata
                    )
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
            writer.finish()
    except (OSError, McapError, ValueError) as error:
        raise ImportSourceError(f"{file}: cannot be read: {error}; `mcap recover` repairs what was cut off") from error


def _unpacked(file: Path, folder: Path) -> Path:
    path = folder / file.stem
    try:
        with file.open("rb") as packed, path.open("wb") as out:
            zstandard.ZstdDecompressor().copy_stream(packed, out)
    except (OSError, zstandard.ZstdError) as error:
        raise ImportSourceError(f"{file}: cannot be unpacked: {error}; copy it again") from error
    named = path.with_suffix(f".{bag_kind(path)}")
    path.rename(named)
    return named
