"""Records on disk, one JSON line each, written as they come, so that a run that ended early goes on where it was."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from research.suites.records import MapRecord, Record, RoomRecord, SceneRecord
from semantic_mapper.errors import ConfigError
from semantic_mapper.files import open_unlinked
from semantic_mapper.log_events import get_logger

_log = get_logger(__name__)

RecordT = TypeVar("RecordT", RoomRecord, MapRecord, SceneRecord)


class RecordStore:
    """Records of any number of runs in one file.

    Raises ConfigError: the file holds something else than records of this version.

    Args:
        path: The file; made with the first record.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._records: dict[tuple[str, str, int], Record] = {}
        if path.exists():
            self._read()

    def find(self, kind: type[RecordT], settings: str, weights: str, room: int) -> RecordT | None:
        """The record of a room made with these settings by these weights; None where it has not been made."""
        record = self._records.get((settings, weights, room))
        return record if isinstance(record, kind) else None

    def add(self, record: Record) -> None:
        """Keep a record, on disk before this returns."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with open(self.path, "ab", opener=open_unlinked) as file:
            file.write(msgspec.json.encode(record) + b"\n")
        self._records[_key(record)] = record

    def _read(self) -> None:
        data = self.path.read_bytes()
        whole, _, rest = data.rpartition(b"\n")
        if rest:  # the process ended while it wrote this line
            _log.warning("last_record_incomplete", file=str(self.path), bytes=len(rest))
            with self.path.open("r+b") as file:
                file.truncate(len(data) - len(rest))
        decoder = msgspec.json.Decoder(Record)
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                record = decoder.decode(line)
            except msgspec.MsgspecError as error:
                raise ConfigError(
                    f"{self.path}: line {number} is not a record of this version ({error}); "
                    "move the file away, or name another one with --json"
                ) from error
            self._records[_key(record)] = record


def _key(record: Record) -> tuple[str, str, int]:
    return record.settings, record.weights, record.room
