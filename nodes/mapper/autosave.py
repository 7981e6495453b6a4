"""Saves a running mapper's map every so often, so that a killed process or a power cut does not take all of it."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import structlog

from semantic_mapper.errors import MapError
from semantic_mapper.mapping.files.map_snapshot import MapSnapshot
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.publishing import PartStatus

FIRST_S = 2.0  # until the first save, twice as long until each further one: who is killed often still gets somewhere
REST_FRACTION = 1.0  # rests as long as it works, so that the next frame finds the processor free half of the time

_log = structlog.get_logger(__name__)


class _GivenUpError(Exception):
    """The mapper ends, and writes its map itself."""


class Autosave:
    """Takes the map between two frames, and writes it in a thread while the next ones are mapped.

    The file is always whole, and of one frame: the map before or the one after, whenever the process is killed.

    Args:
        voxel_map: To be saved, where it has changed.
        path: The file; replaced each time.
        every_s: From the beginning of one save to the next; the first ones come sooner.
    """

    def __init__(
        self,
        voxel_map: VoxelMap,
        path: Path,
        every_s: float,
    ) -> None:
        self.saves = 0
        self.failure = ""  # of the last save; empty where it went well
        self._map = voxel_map
        self._path = path
        self._every_s = every_s
        self._begun = time.monotonic()
        self._begins = 0  # of saves
        self._saved_version = voxel_map.version
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def status(self) -> PartStatus:
        """For the mapper's status."""
        failed = (f"the map was not saved: {self.failure}",) if self.failure else ()
        return PartStatus({"saves": self.saves}, failed)

    def follow(self) -> None:
        """Begin a save if it is time; to be called between two frames."""
        if self._ending.is_set():
            return
        version = self._map.version
        pause_s = min(self._every_s, FIRST_S * 2**self._begins)
        if time.monotonic() - self._begun < pause_s or self._saved_version == version:
            return
        if self._thread is not None and self._thread.is_alive():
            return
        self._begun = time.monotonic()
        self._begins = min(self._begins + 1, 30)
        snapshot = self._map.snapshot()
        self._thread = threading.Thread(target=self._save, args=(snapshot, version), name="autosave", daemon=True)
        self._thread.start()

    def end(self, why: str) -> None:
        """Save no more; ``why`` is reported as the failure of the last save."""
        self.close()
        self.failure = why
        _log.error("autosave_ends", reason=why)

    def close(self) -> None:
        """Give up what is being written; the file is as it was before."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()

    def _save(self, snapshot: MapSnapshot, version: int) -> None:
        worked_since = time.monotonic()

        def rest() -> None:
            nonlocal worked_since
            if self._ending.wait(REST_FRACTION * (time.monotonic() - worked_since)):
                raise _GivenUpError
            worked_since = time.monotonic()

        try:
            snapshot.write(self._path, rest)
        except _GivenUpError:
            _log.info("autosave_given_up", reason="the mapper ends")
        except MapError as error:
            self._fail(str(error))
        except Exception as error:  # noqa: BLE001 -- whatever it is, it must be reported, and the next save tried
            _log.exception("autosave_dies")
            self._fail(f"{type(error).__name__}: {error}")
        else:
            self._saved_version = version
            self.saves += 1
            self.failure = ""

    def _fail(self, reason: str) -> None:
        self.failure = reason
        _log.error("autosave_fails", reason=reason, again_s=self._every_s)
