"""Refines the saved maps of a running mapper, one after the other, in a process of its own (``refining.py``).

Nothing of it goes back into the map. What is found becomes ``refined.npz`` beside the map, and a mirror for queries.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import structlog

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.fields.nesf import find_nesf
from semantic_mapper.mapping.refine import shared_classes
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.nodes.launcher.processes import node_environment
from semantic_mapper.nodes.mapper.refining import REFINED_NAME, Job, read_changes
from semantic_mapper.queries.mirror import MapMirror

FINISH_S = 60.0  # for the map at the end
_POLL_S = 0.2

_log = structlog.get_logger(__name__)


class LiveRefinement:
    """Refines what was saved when it is time, never two maps at once. A context manager.

    Args:
        voxel_map: Of the mapper; only its classes, version and epoch are read.
        path: Of its saved map.
        every_s: From the beginning of one refinement to the next.
        weights: As of ``find_nesf``.
        idle: Compute only while nobody else wants the processor; the last map never waits for that.

    Raises:
        WeightsError: they cannot be read, or are of other classes.
    """

    def __init__(
        self, voxel_map: VoxelMap, path: Path, every_s: float, weights: Path | None, *, idle: bool = True
    ) -> None:
        network = find_nesf(weights, voxel_map.label_set).model
        shared_classes(voxel_map.label_set, network.label_set, by_name=False)
        config = voxel_map.config
        self.mirror = MapMirror(config.voxel_size_m, config.truncation_voxels, voxel_map.label_set)
        self.failure = ""  # of the last refinement; empty where it went well
        self._map = voxel_map
        self._path = path
        self._folder = path.parent / "refining"  # what one process reads and writes
        self._every_s = every_s
        self._weights = weights
        self._idle = idle
        self._count = 0
        self._begun = time.monotonic()
        self._ending = ""  # why nothing further is begun
        self._lock = threading.Lock()  # of ``_ending`` against the start of a process
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    @property
    def counters(self) -> dict[str, int]:
        """For the mapper's status."""
        return {"refinements": self._count, "refined_version": self.mirror.version}

    @property
    def degraded(self) -> tuple[str, ...]:
        """What does not work as it should, for the mapper's status."""
        return (f"the map was not refined: {self.failure}",) if self.failure else ()

    def follow(self, version: int, epoch: int) -> None:
        """Begin to refine the map that has just been saved, if it is time; for the thread that saves.

        Args:
            version, epoch: Of what was saved.
        """
        if self._ending or time.monotonic() - self._begun < self._every_s:
            return
        if self._thread is None or not self._thread.is_alive():
            self._begin(version, epoch, idle=self._idle)

    def give_up(self, why: str) -> None:
        """End the process, and begin nothing further. Harmless when repeated."""
        with self._lock:
            self._ending = self._ending or why
            if self._process is not None:
                self._process.kill()
        if self._thread is not None:
            self._thread.join()

    def finish(self, poll: Callable[[], object]) -> None:
        """Refine the map that was saved at the end, with the processor to itself, within ``FINISH_S``.

        Args:
            poll: Called meanwhile.
        """
        self.give_up("the mapper ends")
        if self.mirror.version == self._map.version and not self.failure:
            return
        self._ending = ""
        self._begin(self._map.version, self._map.epoch, idle=False)
        deadline = time.monotonic() + FINISH_S
        while self._thread is not None and self._thread.is_alive() and time.monotonic() < deadline:
            self._thread.join(_POLL_S)
            poll()
        late = self._thread is not None and self._thread.is_alive()
        self.give_up(f"it took longer than {FINISH_S:g} s")
        if late:
            self._fail(f"{self._ending}; `semantic-mapper refine` does it afterwards")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.give_up("the mapper ends")

    def _begin(self, version: int, epoch: int, *, idle: bool) -> None:
        self._begun = time.monotonic()
        try:
            shutil.rmtree(self._folder, ignore_errors=True)  # of a process that was killed with its mapper
            self._folder.mkdir()
            shutil.copyfile(self._path, self._folder / self._path.name)  # the next save would replace it
        except OSError as error:
            self._fail(str(error))
            return
        job = Job(self._folder / self._path.name, self._weights, idle=idle)
        self._thread = threading.Thread(target=self._run, args=(job, version, epoch), name="refinement", daemon=True)
        self._thread.start()

    def _run(self, job: Job, version: int, epoch: int) -> None:
        try:
            self._refine(job, version, epoch)
        except (SemanticMapperError, OSError) as error:
            self._fail(str(error))
        except Exception as error:  # noqa: BLE001 -- whatever it is, it must be reported, and the next map refined
            _log.exception("refinement_dies")
            self._fail(f"{type(error).__name__}: {error}")
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _refine(self, job: Job, version: int, epoch: int) -> None:
        with self._lock:
            if self._ending:
                return
            # Its standard input ends with this process, and it with that; signals to our group are not for it.
            self._process = process = subprocess.Popen(
                [sys.executable, "-I", "-m", "semantic_mapper.nodes.mapper.refining", *job.arguments()],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                env=node_environment() | ({"OMP_NUM_THREADS": "1"} if job.idle else {}),
                process_group=0,
            )
        with process:
            said = b"" if process.stderr is None else process.stderr.read()
        with self._lock:
            self._process = None
        if self._ending:
            _log.info("refinement_given_up", version=version, reason=self._ending)
            return
        if process.returncode:
            self._fail(_reason(process.returncode, said))
            return
        self.mirror.apply(*read_changes(job.changes, version, epoch))
        job.refined.replace(self._path.with_name(REFINED_NAME))
        self._count += 1
        self.failure = ""
        _log.info("map_refined", version=version, behind=self._map.version - version, s=self._took_s())

    def _took_s(self) -> float:
        return round(time.monotonic() - self._begun, 1)

    def _fail(self, reason: str) -> None:
        self.failure = reason
        _log.error("refinement_fails", reason=reason, again_s=self._every_s)


def _reason(code: int, said: bytes) -> str:
    """Why the process failed."""
    if code < 0:
        return f"its process was killed by signal {-code}"
    lines = said.decode(errors="replace").strip().splitlines()
    return lines[-1][:500] if lines else f"its process ended with code {code}"
