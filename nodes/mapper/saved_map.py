"""The saved map of a running mapper: how it is written now and then, and how a mapper resumes that of a killed one."""

import json
import threading
import time
from collections.abc import Mapping
from concurrent.futures import CancelledError
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np
import structlog

from semantic_mapper.config import MapperConfig, read_toml
from semantic_mapper.errors import ConfigError, MapError
from semantic_mapper.mapping.map_file import open_map
from semantic_mapper.mapping.map_snapshot import FrozenMap
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.node import NodeContext
from semantic_mapper.nodes.publishing import PartStatus
from semantic_mapper.replay.run_folder import free_name
from semantic_mapper.types import Float64

FIRST_S = 2.0  # until the first save, twice as long until each further one: who is killed often still gets somewhere
REST_FRACTION = 1.0  # rests as long as it works, so that the next frame finds the processor free half of the time
_EARLIER, _UNSOUND, _SESSIONS = "earlier", "unsound", "sessions"  # notes
_NO_FILE = "none"
# The map first: it is all that counts.
_RESULTS = ("map.npz", "map.ply", "overview.png", "report.html", "summary.json")

_log = structlog.get_logger(__name__)


class Autosave:
    """Takes the map between two frames where it has changed, and writes it in a thread while the next ones are mapped.

    The file is always whole, and of one frame: the map before or the one after, whenever the process is killed.
    ``every_s`` is from the beginning of one save to the next; the first ones come sooner. 0 = no saves.
    """

    def __init__(self, voxel_map: VoxelMap, path: Path, every_s: float) -> None:
        self.saves = 0
        self.failure = ""  # of the last save; empty where it went well
        self._map = voxel_map
        self._path = path
        self._every_s = every_s
        self._begun = time.monotonic()
        self._pause_s = FIRST_S
        self._saved_version = voxel_map.version
        self._ending = threading.Event()
        if not every_s:
            self._ending.set()
        self._thread: threading.Thread | None = None

    def status(self) -> PartStatus:
        """For the mapper's status."""
        return PartStatus({"saves": self.saves}, (f"the map was not saved: {self.failure}",) if self.failure else ())

    def follow(self) -> None:
        """Begin a save if it is time; to be called between two frames."""
        version = self._map.version
        is_early = time.monotonic() - self._begun < min(self._every_s, self._pause_s)
        is_busy = self._thread is not None and self._thread.is_alive()
        if self._ending.is_set() or is_early or is_busy or self._saved_version == version:
            return
        self._begun = time.monotonic()
        self._pause_s = min(2 * self._pause_s, self._every_s)
        self._thread = threading.Thread(target=self._save, args=(self._map.snapshot(), version), daemon=True)
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

    def _save(self, snapshot: FrozenMap, version: int) -> None:
        worked_since = time.monotonic()

        def rest() -> None:
            nonlocal worked_since
            if self._ending.wait(REST_FRACTION * (time.monotonic() - worked_since)):
                raise CancelledError
            worked_since = time.monotonic()

        try:
            snapshot.write(self._path, rest)
        except CancelledError:
            _log.info("autosave_given_up", reason="the mapper ends")
        except Exception as error:  # noqa: BLE001 -- whatever it is, it must be reported, and the next save tried
            self.failure = str(error) if isinstance(error, MapError) else f"{type(error).__name__}: {error}"
            _log.error("autosave_fails", reason=self.failure, exc_info=not isinstance(error, MapError))
        else:
            self._saved_version = version
            self.saves += 1
            self.failure = ""


def resume_map(context: NodeContext, path: Path, voxel_map: VoxelMap) -> str:
    """In a restarted mapper, make the empty ``voxel_map`` the one that its forerunner has saved in this launch at
    ``path``; a sentence that says what became of that, empty where the mapper was not restarted.

    Poses are of the same session as before, so a saved map continues as if the frames after it had not come. A saved
    map that cannot be gone on with is put aside, so that nothing is written over it. Raises OSError: notes cannot be
    written, or a map cannot be put aside.
    """
    if not context.restarts:
        context.leave_note(_EARLIER, _identity(path))
        return ""
    earlier, there = context.note(_EARLIER), _identity(path)
    if not earlier or there == earlier:
        why = "none had been saved (see save_every_s)"
    elif not (why := context.note(_UNSOUND)):
        try:
            voxel_map.take_over(VoxelMap.load(path))
        except MapError as error:
            why = str(error)
        else:
            _log.info("map_resumed", map=str(path), frames=voxel_map.frames, blocks=voxel_map.block_count)
            return f"the mapper was restarted and went on from the map saved after {voxel_map.frames} frames"
    kept = ""
    if earlier and there not in (earlier, _NO_FILE):
        aside = free_name(path.with_name(f"{path.stem}-before-restart-{context.restarts}{path.suffix}"))
        path.replace(aside)
        context.leave_note(_EARLIER, _NO_FILE)
        context.leave_note(_UNSOUND, "")
        kept = f"; the one before is kept as {aside.name}"
    _log.warning("empty_map_begun", reason=why)
    return f"the mapper was restarted and began an empty map: {why}{kept}"


def continue_map(voxel_map: VoxelMap, saved: VoxelMap, name: str) -> None:
    """Make ``voxel_map`` the saved one, unless it was resumed already; ``ConfigError`` where its classes are others, or
    nobody could find their place in it."""
    if voxel_map.frames:
        return
    try:
        voxel_map.take_over(saved)
        voxel_map.objects_version = voxel_map.version
    except MapError as error:
        raise ConfigError(
            f"{name}: its classes are {saved.label_set.name} ({len(saved.label_set)}), those of the weights "
            f"{voxel_map.label_set.name} ({len(voxel_map.label_set)}): go on with the weights that it was made with"
        ) from error
    if not len(voxel_map.places):
        raise ConfigError(
            f"{name}: has nothing to find oneself by: it was made without depth, by an older release, or with "
            "keyframes.save_places = false; map its log again, or begin a new map"
        )
    _log.info("map_continued", map=name, frames=voxel_map.frames, places=len(voxel_map.places))


def stored_settings(config: MapperConfig, path: Path | None, voxel_size_m: float, saved: Path) -> MapperConfig:
    """The settings of a run that continues a saved map: what its data means is the map's, the rest is this run's.

    What is given, in the TOML file ``path`` or by itself (else 0), is not replaced, so that it may be refused.
    ``MapError`` where the map cannot be read.
    """
    if voxel_size_m or (path and "voxel_size_m" in read_toml(path).get("voxel_map", {})):
        return config
    with open_map(saved) as reader:
        voxel_size = reader.manifest.config.voxel_size_m
    return msgspec.structs.replace(config, voxel_map=msgspec.structs.replace(config.voxel_map, voxel_size_m=voxel_size))


def note_sessions(context: NodeContext, known: Mapping[int, Float64]) -> None:
    """Note where sessions lie in the map, for a mapper that resumes it."""
    plain = json.dumps({str(world): T.ravel().tolist() for world, T in known.items()})
    context.try_to_leave_note(_SESSIONS, plain, "a mapper that replaces it has to look for the camera again")


def noted_sessions(context: NodeContext) -> dict[int, Float64]:
    """What ``note_sessions`` has noted in this launch."""
    noted = json.loads(context.note(_SESSIONS) or "{}")
    return {int(world): np.array(T).reshape(4, 4) for world, T in noted.items()}


def forbid(context: NodeContext, why: str) -> bool:
    """From now on a saved map is not to be gone on with; False where that cannot be noted."""
    return context.try_to_leave_note(_UNSOUND, why, "a mapper that replaces it resumes a map that it should not")


def keep_earlier(context: NodeContext, path: Path) -> None:
    """Move the results of an earlier launch into a folder of their own, before a mapper writes others in their place.

    Live frames do not come again, so that their map is not to be lost to a launch that is restarted. A map (``path``)
    that was saved in the course of this launch stays. ``OSError`` where something cannot be moved.
    """
    there = _identity(path)
    if there == _NO_FILE or context.note(_EARLIER) not in ("", there):
        return
    saved = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    kept = free_name(path.parent / f"earlier-{saved:%Y%m%dT%H%M%SZ}")
    kept.mkdir()
    for file in (*map(path.with_name, _RESULTS), *path.parent.glob(f"{path.stem}-before-restart-*{path.suffix}")):
        if file.exists():
            file.rename(kept / file.name)
    context.leave_note(_EARLIER, _NO_FILE)
    _log.warning("earlier_results_kept", folder=str(kept))


def _identity(path: Path) -> str:
    try:
        stat = path.stat()
    except FileNotFoundError:
        return _NO_FILE
    return f"{stat.st_ino} {stat.st_mtime_ns} {stat.st_size}"
