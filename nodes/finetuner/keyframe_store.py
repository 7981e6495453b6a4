"""The labelled keyframes of a finetuner on disk, from which a restarted one goes on.

Each keyframe is a file: the message that it came as, named by the SHA-256 of its content. ``learning.json`` lists them
with their state.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import structlog

from semantic_mapper.config import convert_config
from semantic_mapper.errors import CodecError, ConfigError, SemanticMapperError
from semantic_mapper.files import read_regular, write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.options import Count
from semantic_mapper.replay.run_folder import free_name
from semantic_mapper.training.online import Kept, KeyframePool
from semantic_mapper.transport.codec import decode_as, encode, pack_parts, unpack_parts
from semantic_mapper.transport.messages import MAX_KEYFRAME_BYTES, LabelledKeyframe, digest_of
from semantic_mapper.types import PosedFrame

FOLDER = "learning"  # next to the map
MAX_RECORD_BYTES = 1 << 20
MAX_FILE_BYTES = MAX_KEYFRAME_BYTES + 4096  # with its framing

_RECORD = "learning.json"
_SUFFIX = ".keyframe"

_log = structlog.get_logger(__name__)


class _KeptFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    digest: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256 of the file
    held_out: bool
    validated: bool = False
    trials: Count = 0


class Progress(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of a finetuner apart from its keyframes."""

    failures: Count = 0  # consecutive rounds that failed
    learning: bool = False  # in the middle of a round


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    progress: Progress = Progress()
    keyframes: Annotated[tuple[_KeptFile, ...], msgspec.Meta(max_length=4096)] = ()


class LearningStore:
    """A folder, made when there is something to save, with the keyframes of a pool and the progress of a finetuner."""

    def __init__(self, folder: Path, label_set: LabelSet) -> None:
        self._folder = folder
        self._label_set = label_set
        self._saved: dict[str, PosedFrame] = {}  # by digest
        self._record: _Record | None = None

    def put_aside(self) -> None:
        """Rename the folder of another launch, whose keyframes people may have labelled; then begin with nothing."""
        record = self._folder / _RECORD
        if not record.exists() or not any(self._folder.glob(f"*{_SUFFIX}")):
            record.unlink(missing_ok=True)
            return
        left = datetime.fromtimestamp(record.stat().st_mtime, UTC)
        kept = free_name(self._folder.with_name(f"{self._folder.name}-earlier-{left:%Y%m%dT%H%M%SZ}"))
        self._folder.rename(kept)
        _log.warning("earlier_keyframes_kept", folder=str(kept))

    def keep(self, kept: Sequence[Kept], progress: Progress) -> None:
        """Save what has changed since the last call. ``OSError``: it cannot be written; the last state stays."""
        files = tuple(_KeptFile(self._save(k.frame), k.held_out, k.validated, k.trials) for k in kept)
        record = _Record(progress=progress, keyframes=files)
        if record == self._record:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        write_bytes(self._folder / _RECORD, msgspec.json.format(msgspec.json.encode(record), indent=1))
        self._record = record
        listed = {file.digest for file in files}
        self._saved = {digest: frame for digest, frame in self._saved.items() if digest in listed}
        for path in self._folder.glob(f"*{_SUFFIX}"):
            if path.stem not in listed:
                path.unlink(missing_ok=True)

    def restore(self, pool: KeyframePool) -> Progress:
        """Fill a pool with the keyframes of the folder; damaged ones are left out, with a warning."""
        record = self._read_record()
        for file in record.keyframes:
            try:
                data = read_regular(self._path(file.digest), MAX_FILE_BYTES)
                if digest_of(data) != file.digest:
                    raise CodecError("the file is damaged")
                keyframe = decode_as(LabelledKeyframe, unpack_parts(data))
                pool.restore(Kept(keyframe.frame, file.held_out, file.validated, file.trials), keyframe.label_set)
            except (SemanticMapperError, FileNotFoundError) as error:
                _log.warning("keyframe_lost", file=file.digest, reason=str(error))
        return record.progress

    def _read_record(self) -> _Record:
        path = self._folder / _RECORD
        try:
            return convert_config(msgspec.json.decode(read_regular(path, MAX_RECORD_BYTES)), _Record, str(path))
        except FileNotFoundError:
            pass
        except (ConfigError, ValueError) as error:
            _log.warning("keyframes_lost", reason=f"{path}: {error}")
        return _Record()

    def _save(self, frame: PosedFrame) -> str:
        for digest, saved in self._saved.items():
            if saved is frame:
                return digest
        data = pack_parts(encode(LabelledKeyframe(frame, self._label_set, "kept")))
        digest = digest_of(data)
        if not self._path(digest).exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self._path(digest), data)
        self._saved[digest] = frame
        return digest

    def _path(self, digest: str) -> Path:
        return self._folder / f"{digest}{_SUFFIX}"
