"""A log -> the format of another program: choose the writer, give it the frames, say what it could not hold."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from semantic_mapper.errors import CodecError, ConfigError, LogError
from semantic_mapper.files import atomic_folder, atomic_path, write_bytes
from semantic_mapper.mapping.map_types import require_metres
from semantic_mapper.replay.autolabel_note import AUTOLABEL_ATTACHMENT
from semantic_mapper.replay.exporters.base import Exporter, ExportFrame, LeftOut, choose_format, encoded
from semantic_mapper.replay.exporters.folder import FolderExporter, TrajectoryExporter, TumExporter
from semantic_mapper.replay.exporters.foxglove import FoxgloveExporter
from semantic_mapper.replay.exporters.lerobot import LeRobotExporter
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.transport.codec import EncodedImage, Envelope, decode_as
from semantic_mapper.transport.images import sniff_image
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import PosedFrame

LogFormat = Literal["foxglove", "trajectory", "tum", "folder", "lerobot"]
FORMATS: tuple[LogFormat, ...] = get_args(LogFormat)
_SUFFIXES: dict[str, LogFormat] = {".mcap": "foxglove", ".txt": "trajectory", ".tum": "trajectory", "": "folder"}
_FOLDERS = ("tum", "folder", "lerobot")
_ONE_CAMERA = ("trajectory", *_FOLDERS)


class LogExportReport(NamedTuple):
    """What was written: how many frames, those that could not be with the reason, and what the format cannot hold."""

    frames: int
    left_out: tuple[str, ...]
    notices: tuple[str, ...]


def log_format_of(path: Path, given: str | None) -> LogFormat:
    """See ``choose_format``."""
    return choose_format(path, given, _SUFFIXES, FORMATS)


def export_log(
    log: Log,
    out: Path,
    name: LogFormat,
    *,
    camera: str = "",
    max_frames: int = 0,
    on_frame: Callable[[], None] = lambda: None,
) -> LogExportReport:
    """Write the frames of a log, at most ``max_frames`` (0 = all), to a file or folder that is there only once it is
    whole; those of one ``camera``, without which all but Foxglove refuse a log of several. Damaged frames
    are passed over and stand in the ``errors`` of the log. ``on_frame`` is called for each frame that was looked at.

    Raises ConfigError: a camera that is not in the log, or several where the format holds one. MapError: the format
    states metres, and the log has none. LogError: ``out`` is there already (a file that is no log is replaced), or
    cannot be written; or no frame could be.
    """
    if name == "tum":
        require_metres(log.info.scale_known, f"{out}: depth and poses of a TUM sequence are in metres")
    is_folder = name in _FOLDERS
    is_log = out.suffix == ".mcap" or out.resolve() in [path.resolve() for path in log.paths]
    if out.exists() and (is_folder or out.is_dir() or is_log):
        raise LogError(f"{out}: exists already, and only a file that is no log is replaced; give another name")
    camera = _choose_camera(log, camera, name)
    left_out: list[str] = []
    frames = 0
    with (atomic_folder if is_folder else atomic_path)(out, raises=LogError) as place:
        exporter = _exporter(place, log.info, name)
        note = log.attachments().get(AUTOLABEL_ATTACHMENT)
        if name == "folder" and note is not None:
            write_bytes(place / AUTOLABEL_ATTACHMENT, note.data, raises=LogError)
        frames_of_it = ((e, parts) for e, parts in log.frame_parts() if not camera or e.source == camera)
        for envelope, parts in islice(frames_of_it, max_frames or None):
            on_frame()
            try:
                exporter.add(_unpacked(envelope, parts))
            except (LeftOut, CodecError) as error:
                left_out.append(f"frame seq={envelope.seq} of camera '{envelope.source}': {error}")
            else:
                frames += 1
        exporter.finish()
        if not frames:
            why = left_out[0] if left_out else "it holds none that can be read"
            raise LogError(f"{log.path}: no frame could be written: {why}")
    scale = () if log.info.scale_known else ("scale: unknown; lengths are not metres",)
    return LogExportReport(frames, tuple(left_out), (*exporter.notices, *scale))


def _exporter(place: Path, info: StreamInfo, name: LogFormat) -> Exporter:
    if name == "foxglove":
        return FoxgloveExporter(place, info)
    if name == "trajectory":
        return TrajectoryExporter(place, info.scale_known)
    if name == "lerobot":
        return LeRobotExporter(place, info)
    return TumExporter(place) if name == "tum" else FolderExporter(place, info)


def _choose_camera(log: Log, camera: str, name: LogFormat) -> str:
    """The camera to write, empty = all."""
    if not camera and name not in _ONE_CAMERA:
        return ""
    there = sorted({envelope.source for envelope, _ in log.frame_parts()})
    if camera not in there if camera else len(there) > 1:
        raise ConfigError(f"{name}: name one camera of the log with --camera: {', '.join(there) or 'it has no camera'}")
    return camera


def _unpacked(envelope: Envelope, parts: list[bytes]) -> ExportFrame:
    frame = decode_as(PosedFrame, parts)
    if envelope.rgb_encoding == "raw":
        return ExportFrame(frame, encoded(frame.rgb), envelope.depth_scale)
    encoding, _ = sniff_image(parts[2])
    return ExportFrame(frame, EncodedImage(encoding, parts[2]), envelope.depth_scale)
