"""What a finetuner keeps on disk of its labelled keyframes, so that the process that takes its place has them, too.

A keyframe is a file of its own, the message that it came as, called by the digest of its content. ``learning.json``
says which there are and what has become of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import msgspec
import structlog

from semantic_mapper.config import Config, convert_config
from semantic_mapper.errors import CodecError, ConfigError, SemanticMapperError
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.nodes.cli.outputs import free_name
from semantic_mapper.nodes.options import Count
from semantic_mapper.training.keyframe_pool import Kept, KeyframePool
from semantic_mapper.transport.codec import decode_as, encode
from semantic_mapper.transport.framing import pack_parts, unpack_parts
from semantic_mapper.transport.messages import MAX_KEYFRAME_BYTES, LabelledKeyframe, digest_of
from semantic_mapper.types import PosedFrame

FOLDER = "learning"  # beside the map
MAX_RECORD_BYTES = 1 << 20
MAX_FILE_BYTES = MAX_KEYFRAME_BYTES + 4096  # with its framing

_RECORD = "learning.json"
_SUFFIX = ".keyframe"

_log = structlog.get_logger(__name__)


class KeptFile(Config, frozen=True):
    """A keyframe on disk, see ``Kept``."""

    digest: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]  # SHA-256 of the file, which is called so
    held_out: bool
    proved_at: Count | None = None
    trials: Count = 0


class Progress(Config, frozen=True):
    """How far a finetuner is, apart from its keyframes."""

    rolled_back: Count = 0  # as the mapper told last
    failures: Count = 0  # rounds that failed, one after another
    learning: bool = False  # in the middle of a round


class _Record(Config, frozen=True):
    progress: Progress
    keyframes: Annotated[tuple[KeptFile, ...], msgspec.Meta(max_length=4096)]


class LearningStore:
    """The keyframes of a pool and the progress of a finetuner, in a folder of their own.

    Args:
        folder: Made when there is something to keep.
        label_set: Of the pool.
    """

    def __init__(self, folder: Path, label_set: LabelSet) -> None:
        self._folder = folder
        self._label_set = label_set
        self._digests: dict[str, PosedFrame] = {}  # on disk
        self._written: _Record | None = None

    def put_aside(self) -> None:
        """Begin with nothing; what another launch has left, which people may have labelled, stays beside.

        Raises:
            OSError: it cannot be moved.
        """
        record = self._folder / _RECORD
        if not record.exists() or not any(self._folder.glob(f"*{_SUFFIX}")):
            record.unlink(missing_ok=True)
            return
        left = datetime.fromtimestamp(record.stat().st_mtime, UTC)
        kept = free_name(self._folder.with_name(f"{self._folder.name}-earlier-{left:%Y%m%dT%H%M%SZ}"))
        self._folder.rename(kept)
        _log.warning("earlier_keyframes_kept", folder=str(kept))

    def keep(self, kept: Sequence[Kept], progress: Progress) -> None:
        """Make the files what they should be; cheap where they are.

        Raises:
            OSError: they cannot be written; the last complete state stays.
        """
        files = tuple(_file_of(k, self._write(k.frame)) for k in kept)
        record = _Record(progress=progress, keyframes=files)
        if record == self._written:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        write_bytes(self._folder / _RECORD, msgspec.json.format(msgspec.json.encode(record), indent=1))
        self._written = record
        named = {file.digest for file in files}
        self._digests = {digest: frame for digest, frame in self._digests.items() if digest in named}
        self._delete_others(named)

    def restore(self, pool: KeyframePool) -> Progress:
        """Fill a pool with what was kept; what is damaged is told of and left out.

        Raises:
            OSError: there are files that cannot be read.
        """
        record = self._read_record()
        for file in record.keyframes:
            try:
                keyframe = self._read(file)
                pool.restore(Kept(keyframe.frame, file.held_out, file.proved_at, file.trials), keyframe.label_set)
            except SemanticMapperError as error:
                _log.warning("keyframe_lost", file=file.digest, reason=str(error))
        return record.progress

    def _read_record(self) -> _Record:
        path, nothing = self._folder / _RECORD, _Record(progress=Progress(), keyframes=())
        if not path.exists():
            return nothing
        try:
            if path.stat().st_size > MAX_RECORD_BYTES:
                raise ConfigError(f"{path}: more than {MAX_RECORD_BYTES} bytes")
            return convert_config(msgspec.json.decode(path.read_bytes()), _Record, str(path))
        except (ConfigError, msgspec.DecodeError, UnicodeDecodeError) as error:
            _log.warning("keyframes_lost", reason=f"{path}: {error}")
            return nothing

    def _read(self, file: KeptFile) -> LabelledKeyframe:
        path = self._path(file.digest)
        if not path.exists():
            raise CodecError(f"{path}: is gone")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise CodecError(f"{path}: more than {MAX_FILE_BYTES} bytes")
        data = path.read_bytes()
        if digest_of(data) != file.digest:
            raise CodecError(f"{path}: is damaged")
        return decode_as(LabelledKeyframe, unpack_parts(data))

    def _write(self, frame: PosedFrame) -> str:
        known = next((digest for digest, written in self._digests.items() if written is frame), None)
        if known is not None:
            return known
        data = pack_parts(encode(LabelledKeyframe(frame, self._label_set, "kept")))
        digest = digest_of(data)
        if not self._path(digest).exists():
            self._folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self._path(digest), data)
        self._digests[digest] = frame
        return digest

    def _path(self, digest: str) -> Path:
        return self._folder / f"{digest}{_SUFFIX}"

    def _delete_others(self, digests: Iterable[str]) -> None:
        names = {self._path(digest) for digest in digests}
        for path in self._folder.glob(f"*{_SUFFIX}"):
            if path not in names:
                path.unlink(missing_ok=True)


def _file_of(kept: Kept, digest: str) -> KeptFile:
    return KeptFile(digest=digest, held_out=kept.held_out, proved_at=kept.proved_at, trials=kept.trials)
