"""The driver of a fleet run: hands logs to workers, tries again, sets aside what fails, and says how far it is.

Ray places the tasks and finds out what has died. The driver keeps no result: what is done is in the store, so that a
driver that was killed is started again, and several may work at the same time. Each goes through the logs in an order
of its own, so that they meet seldom.
"""

from __future__ import annotations

import faulthandler
import hashlib
import heapq
import os
import random
import secrets
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from semantic_mapper.backoff import backoff_s
from semantic_mapper.errors import FleetError, SemanticMapperError, StoreError
from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.fleet.cluster import Cluster
from semantic_mapper.nodes.fleet.code_version import code_version
from semantic_mapper.nodes.fleet.inputs import LogInput
from semantic_mapper.nodes.fleet.results import Failure
from semantic_mapper.nodes.fleet.scratch import DiskError
from semantic_mapper.nodes.fleet.store import Store
from semantic_mapper.nodes.fleet.urls import shown
from semantic_mapper.nodes.fleet.worker import OtherCodeError, Outcome, Task, run_task
from semantic_mapper.redaction import without_secrets

FAILURES = 2  # of a log, and it is quarantined
CRASHES = 3  # of the process that works on a log: the first may have been the machine's fault
LOST_NODES = 20  # that a log may have been on
UNREACHABLE = 4  # times that log or store could not be reached, or the disk was full, before a log is quarantined
LOGS_IN_A_ROW = 5  # to which that happens, none in between is done, and the run ends
FIRST_PAUSE_S, MAX_PAUSE_S = 1.0, 60.0
AHEAD = 2  # tasks handed to Ray for each that can run
LOOK_S = 2.0  # how often the cluster is asked for its nodes
REPORT_S = 5.0  # how often progress is written to the store
MAX_ERROR = 2000  # letters
MAX_LISTED = 50  # quarantined logs that a run names

_log = get_logger(__name__)


class DriverStatus(msgspec.Struct, frozen=True):
    """``drivers/ID.json``: how far a run is, for ``fleet top``.

    Args:
        id, host, pid: Of the driver.
        operation, version: What it does.
        cluster: Where, for people.
        total, done, existing, failed, retries, running: Logs; ``existing`` had a result already.
        rate: Logs done a second, over the run so far.
        eta_s: Seconds left, None where nobody knows.
        started_ns, updated_ns: Nanoseconds since 1970.
        ended: "" while it runs; then "done", "stopped" or what went wrong.
    """

    id: str
    host: str
    pid: int
    operation: str
    version: str
    cluster: str
    total: int
    done: int
    existing: int
    failed: int
    retries: int
    running: int
    rate: float
    eta_s: float | None
    started_ns: int
    updated_ns: int
    ended: str = ""


@dataclass(frozen=True, slots=True)
class Resources:
    """What Ray reserves for a task.

    Args:
        cpus, gpus: Also fractions.
        memory_bytes: Of its node.
        max_parallel: Tasks at a time; 0 = what the cluster has room for.
        timeout_s: A task that runs for longer is ended and counts as failed; 0 = none.
    """

    cpus: float = 1.0
    gpus: float = 0.0
    memory_bytes: int = 2 << 30
    max_parallel: int = 0
    timeout_s: float = 0.0


@dataclass(slots=True)
class _Try:
    """A log that waits or runs."""

    task: Task
    errors: list[str] = field(default_factory=list[str])
    failures: int = 0
    crashes: int = 0
    lost: int = 0
    unreachable: int = 0
    since: float = 0.0  # handed to Ray


class FleetRun:
    """One ``fleet run``.

    Args:
        store: Gets results.
        template: The task but for its log.
        inputs: The logs.
        resources: Of each task.
        cluster: That was started or joined.
        retry_quarantined: Also do logs that failed in earlier runs.
        function: What a worker does; tests and benchmarks give another one.
    """

    def __init__(
        self,
        store: Store,
        template: Task,
        inputs: Sequence[LogInput],
        resources: Resources,
        cluster: Cluster,
        *,
        retry_quarantined: bool = False,
        function: Callable[[Task], Outcome] = run_task,
    ) -> None:
        self._store, self._template, self._resources = store, template, resources
        self._retry_quarantined = retry_quarantined
        order = list(inputs)
        random.Random(secrets.randbits(64)).shuffle(order)
        self._inputs = iter(order)
        self._function = function
        self._running: dict[Any, _Try] = {}
        self._waiting: list[tuple[float, int, _Try]] = []  # by the time when it may be tried again
        self._order = 0
        self._known_failures: dict[str, Failure] = {}  # of earlier runs
        self.failures: list[Failure] = []  # of this run, and those that it left out; the first ones
        self._in_a_row = set[str]()
        self._fit, self._looked = 0, -LOOK_S
        self._began = time.monotonic()
        self.status = DriverStatus(
            id=f"{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(3)}",
            host=socket.gethostname(),
            pid=os.getpid(),
            operation=template.operation,
            version=code_version(),
            cluster=cluster.address + (", trusted network" if cluster.trusted_network else ""),
            total=len(order),
            done=0,
            existing=0,
            failed=0,
            retries=0,
            running=0,
            rate=0.0,
            eta_s=None,
            started_ns=time.time_ns(),
            updated_ns=time.time_ns(),
        )

    def run(self, stopped: Callable[[], object], on_progress: Callable[[DriverStatus], None]) -> DriverStatus:
        """Go through all logs.

        Args:
            stopped: Looked at often; once it is true, tasks that run are ended and the run is over.
            on_progress: Called after each change.

        Raises:
            FleetError: the cluster cannot run the tasks.
            StoreError: the store cannot be reached for long.
        """
        import ray

        remote = ray.remote(_bounded(self._function, self._resources.timeout_s)).options(
            num_cpus=self._resources.cpus,
            num_gpus=self._resources.gpus,
            memory=self._resources.memory_bytes,
            max_retries=0,  # tried again here, after a pause and with a limit
            scheduling_strategy="SPREAD",
            name=f"fleet {self._template.operation}",
        )
        self._known_failures = {failure.key: failure for failure in self._store.failures()}
        self._check_fits()
        reported = 0.0
        ended = "stopped by an error"
        try:
            while not stopped():
                self._submit(remote)
                if not self._running and not self._waiting:
                    ended = "done"
                    break
                self._collect()
                on_progress(self._updated())
                if time.monotonic() - reported > REPORT_S:
                    self._report()
                    reported = time.monotonic()
            else:
                ended = "stopped"
                for reference in self._running:
                    ray.cancel(reference, force=True)
        except SemanticMapperError as error:
            ended = str(error)[:MAX_ERROR]
            raise
        finally:
            self.status = msgspec.structs.replace(self._updated(), ended=ended)
            self._report()
        return self.status

    def _check_fits(self) -> None:
        """Refuse at once what would wait for ever."""
        nodes = _living_nodes()
        if any(_fit(node, self._resources) for node in nodes):
            return
        found = "; ".join(sorted({_described(node) for node in nodes}))
        raise FleetError(
            f"a task needs {_described(_needs(self._resources))}, which no node of the cluster has ({found}); ask for "
            "less (--cpus, --gpus, --memory) or join a larger cluster"
        )

    def _room(self) -> int:
        """How many tasks may be in Ray's hands."""
        if self._resources.max_parallel:
            return self._resources.max_parallel
        if time.monotonic() - self._looked > LOOK_S:  # nodes come and go
            self._looked = time.monotonic()
            self._fit = sum(_fit(node, self._resources) for node in _living_nodes())
        return AHEAD * max(self._fit, 1)

    def _submit(self, remote: Any) -> None:
        room = self._room()
        while len(self._running) < room and (attempt := self._next()) is not None:
            attempt.since = time.monotonic()
            self._running[remote.remote(attempt.task)] = attempt

    def _next(self) -> _Try | None:
        if self._waiting and self._waiting[0][0] <= time.monotonic():
            return heapq.heappop(self._waiting)[2]
        for item in self._inputs:
            task = replace(self._template, url=item.url, tags=item.tags)
            failure = self._known_failures.get(_failure_key(task))
            if failure is not None and failure.code == task.code and not self._retry_quarantined:
                self._note_failure(failure)
                continue
            return _Try(task)
        return None

    def _collect(self) -> None:
        """Take what has ended, or wait for a moment."""
        import ray

        references = list(self._running)
        if not references:
            time.sleep(min(0.2, max(self._waiting[0][0] - time.monotonic(), 0.0)))
            return
        ended, _ = ray.wait(references, num_returns=1, timeout=0.2)
        if ended:
            more, _ = ray.wait(references, num_returns=len(references), timeout=0)
            for reference in more:
                self._take(reference, self._running.pop(reference))

    def _take(self, reference: Any, attempt: _Try) -> None:
        import ray
        from ray import exceptions

        try:
            outcome: Outcome = ray.get(reference)
        except exceptions.RayTaskError as error:
            self._failed(attempt, error.cause, str(error.cause))
        except (exceptions.WorkerCrashedError, exceptions.OutOfMemoryError) as error:
            self._died(attempt, error)
        except exceptions.RayError as error:  # the node died, or the answer is lost: not the log's fault
            self._lost(attempt, f"{type(error).__name__}: {error}")
        else:
            self._in_a_row.clear()
            if _failure_key(attempt.task) in self._known_failures:
                self._store.release(_failure_key(attempt.task))
            self._count(done=outcome.status == "done", existing=outcome.status == "exists")

    def _failed(self, attempt: _Try, cause: BaseException, text: str) -> None:
        if isinstance(cause, OtherCodeError):
            raise FleetError(text) from cause  # every log would fail like that
        if isinstance(cause, StoreError | DiskError):
            self._in_a_row.add(attempt.task.url)
            if len(self._in_a_row) >= LOGS_IN_A_ROW:
                raise type(cause)(f"{text}; so it went for {LOGS_IN_A_ROW} logs in a row; what is done is kept")
            attempt.unreachable += 1
            self._again(attempt, text, attempt.unreachable >= UNREACHABLE)
            return
        attempt.failures += 1
        self._again(attempt, f"{type(cause).__name__}: {text}", attempt.failures >= FAILURES)

    def _died(self, attempt: _Try, error: BaseException) -> None:
        timeout_s = self._resources.timeout_s
        if timeout_s and time.monotonic() - attempt.since >= timeout_s:
            attempt.failures += 1
            self._again(attempt, f"took longer than {timeout_s:g} s, and was ended", attempt.failures >= FAILURES)
            return
        attempt.crashes += 1
        self._again(attempt, f"the process died: {error}", attempt.crashes >= CRASHES)

    def _lost(self, attempt: _Try, text: str) -> None:
        attempt.lost += 1
        self._again(attempt, f"the node was lost: {text}", attempt.lost >= LOST_NODES)

    def _again(self, attempt: _Try, error: str, give_up: bool) -> None:
        task = attempt.task
        attempt.errors.append(without_secrets(" ".join(error.split()))[:MAX_ERROR])
        if give_up:
            _log.error("log_quarantined", log=shown(task.url), error=attempt.errors[-1])
            failure = Failure(
                key=_failure_key(task),
                operation=task.operation,
                log=shown(task.url),
                tags=dict(task.tags),
                version=self.status.version,
                errors=tuple(attempt.errors),
                finished_ns=time.time_ns(),
                code=task.code,
            )
            self._store.quarantine(failure)
            self._note_failure(failure)
            return
        pause_s = backoff_s(len(attempt.errors), FIRST_PAUSE_S, MAX_PAUSE_S)
        _log.warning("log_failed", log=shown(task.url), error=attempt.errors[-1], again_in_s=pause_s)
        attempt.task = replace(task, attempt=task.attempt + 1)
        self._order += 1
        heapq.heappush(self._waiting, (time.monotonic() + pause_s, self._order, attempt))
        self._count(retries=1)

    def _note_failure(self, failure: Failure) -> None:
        if len(self.failures) < MAX_LISTED:
            self.failures.append(failure)
        self._count(failed=1)

    def _count(self, **more: int) -> None:
        changed = {name: getattr(self.status, name) + int(count) for name, count in more.items()}
        self.status = msgspec.structs.replace(self.status, **changed)

    def _updated(self) -> DriverStatus:
        status = self.status
        seconds = time.monotonic() - self._began
        over = status.done + status.existing + status.failed
        rate = status.done / max(seconds, 1e-9)
        per_log = seconds / over if over else None
        self.status = msgspec.structs.replace(
            status,
            running=min(len(self._running), self._resources.max_parallel or self._fit),
            rate=round(rate, 4),
            eta_s=None if per_log is None else round(per_log * (status.total - over), 1),
            updated_ns=time.time_ns(),
        )
        return self.status

    def _report(self) -> None:
        """Say in the store how far it is; a run does not end for want of that."""
        try:
            self._store.write(f"drivers/{self.status.id}.json", msgspec.json.encode(self.status), tries=1)
        except StoreError as error:
            _log.warning("progress_not_written", error=str(error))


def _bounded(function: Callable[[Task], Outcome], timeout_s: float) -> Callable[[Task], Outcome]:
    """The function in a process that ends itself after a time, even in native code."""
    if not timeout_s:
        return function

    def run(task: Task) -> Outcome:
        faulthandler.dump_traceback_later(timeout_s, exit=True)
        try:
            return function(task)
        finally:
            faulthandler.cancel_dump_traceback_later()

    return run


def _living_nodes() -> list[dict[str, float]]:
    """Resources of each node of the cluster."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _needs(resources: Resources) -> dict[str, float]:
    """By Ray's names."""
    needed = {"CPU": resources.cpus, "GPU": resources.gpus, "memory": float(resources.memory_bytes)}
    return {name: amount for name, amount in needed.items() if amount}


def _described(node: dict[str, float]) -> str:
    """CPUs, GPUs and memory, for people."""
    gpus = f", {node['GPU']:g} GPUs" if node.get("GPU") else ""
    return f"{node.get('CPU', 0.0):g} CPUs{gpus}, {node.get('memory', 0.0) / 1e9:.3g} GB of memory"


def _fit(node: dict[str, float], resources: Resources) -> int:
    """How many tasks a node has room for."""
    return min(int(node.get(name, 0.0) / needed) for name, needed in _needs(resources).items())


def _failure_key(task: Task) -> str:
    """Of a log and what is done with it; other code tries it again."""
    text = "\n".join((task.operation, task.url, task.weights_digest, msgspec.json.encode(task.settings).decode()))
    return hashlib.sha256(text.encode()).hexdigest()[:40]
