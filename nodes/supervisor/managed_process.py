"""One node of a launch over all its restarts."""

from __future__ import annotations

import math
import time

import msgspec
import structlog

from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.supervisor.backoff import RestartBackoff
from semantic_mapper.nodes.supervisor.fork_server import ForkServer
from semantic_mapper.nodes.supervisor.hang_detector import BUSY_SILENCE_S, HangDetector
from semantic_mapper.nodes.supervisor.launch_config import Launch, NodeEntry
from semantic_mapper.nodes.supervisor.node_process import KILL_S, NodeProcess
from semantic_mapper.nodes.supervisor.progress import ProgressLimit, cpu_seconds
from semantic_mapper.transport.messages import NodeState

ORPHAN_TIMEOUT_S = 120  # see ``NodeJob.orphan_timeout_s``

_log = structlog.get_logger(__name__)


class ManagedProcess:
    """Starts a node at once, and again where it fails and its launch file says so.

    Args:
        entry: Of the launch file.
        launch: For its options and limits.
        endpoints: Of all nodes.
        folder: Of the launch.
        server: Forks the processes of preloaded kinds; None = each is a new interpreter.
    """

    def __init__(
        self,
        entry: NodeEntry,
        launch: Launch,
        endpoints: dict[str, str],
        folder: str,
        server: ForkServer | None = None,
    ) -> None:
        self.name = entry.name
        self.kind = entry.kind
        self.process: NodeProcess | None = None
        self.failure = ""  # why it is not started any more
        self.failed_at = 0.0
        self._entry = entry
        self._launch = launch
        self._server = server
        self._job = NodeJob(
            name=entry.name,
            options=msgspec.to_builtins(launch.options[entry.name]),
            endpoints=endpoints,
            subscribers=launch.listeners(entry.name),
            folder=folder,
            restartable=entry.restart != "never",
            # The kernel ends what is silent for so long; before, it is the launcher's turn.
            orphan_timeout_s=math.ceil(max(ORPHAN_TIMEOUT_S, 2 * launch.heartbeat_s, 2 * BUSY_SILENCE_S)),
        )
        self._backoff = RestartBackoff(entry)
        self._due = 0.0  # of the next start, while there is no process
        self._last_end = self._last_reason = ""
        self._finishing = self._hopeless = False
        self._start()

    @property
    def restarts(self) -> int:
        """How often it was restarted."""
        return self._backoff.count

    @property
    def runs(self) -> bool:
        """Whether it has a process, or is about to have one."""
        if self.process is None or self.process.has_failed():  # not given up before ``look_after`` says so
            return not self.failure
        return self.process.exit_code() is None

    @property
    def state(self) -> NodeState:
        """Where it is in its life, as far as its launcher can tell."""
        if self.process is None:
            return "ended" if self.failure else "starting"
        if self.process.exit_code() is not None:
            return "ended"
        if self.process.asked_to_stop or self.process.heartbeat.ending:
            return "stopping"
        return "running" if self.process.heartbeat.ready else "starting"

    @property
    def loss(self) -> str:
        """What a node that has ended in order has lost, with its last words; empty = nothing that it knows of."""
        return self.process.describe_end() if self.process is not None and self.process.has_lost else ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What happened to it lately."""
        if self.failure or self.loss:
            return (self.failure or self.loss,)
        lately = self._backoff.lately(time.monotonic())
        if not lately:
            return ()
        times = "once" if lately == 1 else f"{lately} times"
        return (f"restarted {times} in the last {self._entry.window_s:g} s; the last time: {self._last_reason}",)

    def look_after(self, *, last: bool) -> None:
        """Start it if it is time to; find out whether it has failed or hangs.

        Args:
            last: The launch ends: what fails now is not started any more.
        """
        if self.process is None:
            if last and not self.failure:
                self._give_up(f"{self._last_end}; it had not been restarted yet when the launch ended")
            elif not self.failure and time.monotonic() >= self._due:
                self._start()
        elif self.process.exit_code() is None:
            hang = self._detector.find_hang(stopping=self.process.asked_to_stop)
            if hang:
                self.process.kill()
                self.process.wait(KILL_S)
                self._on_failure(self.process, hang, last=last)
        elif last and self.process.was_terminated:
            self.process.ask_to_stop()  # the process that ends us may have sent the signal to all of us
        elif self.process.has_failed() and not self.failure:
            self._on_failure(self.process, "", last=last)

    def gets_on(self, limit_s: float) -> bool:
        """Whether it comes nearer to its end; to be asked often while that is awaited.

        Args:
            limit_s: Seconds without progress. Once it writes its results, turns are progress, too.
        """
        if self.process is None:
            return self.runs
        if self._end_limit is None:
            pid = self.process.pid
            self._end_limit = ProgressLimit(limit_s, lambda: cpu_seconds(pid))
        beat = self.process.heartbeat
        return self.runs and not self._end_limit.exceeded(beat.turns if beat.ending else -1)

    def overstay(self, patience_s: float) -> None:
        """End a process that has not ended when it should have; that is a failure."""
        if self.process is None or self.process.exit_code() is not None:
            return
        self.process.ask_to_stop()
        if not self.process.wait(KILL_S):
            self.process.kill()
            self.process.wait(KILL_S)
        self._on_failure(self.process, f"it did not end, and made no progress for {patience_s:g} s", last=True)

    def ask_to_stop(self) -> None:
        """Ask its process, if there is one."""
        if self.process is None or (self._finishing and not self.process.heartbeat.ready):  # it would end at once
            return
        self.process.ask_to_stop()

    def start_to_finish(self) -> None:
        """Start a node that is given up once more, to be stopped: it writes results of what it saved."""
        if not self.failure or self._finishing or self._hopeless or self._entry.restart == "never":
            return
        self._finishing = True
        before = self.process
        try:
            self._start_process(self.restarts + 1)  # it goes on from what this launch saved
        except OSError as error:
            _log.error("results_not_written", node=self.name, reason=str(error))
            return
        if before is not None:
            before.close()
        _log.info("node_finishes", node=self.name, pid=self.process.pid if self.process else 0)

    def close(self) -> None:
        """Leave no process behind."""
        if self.process is not None:
            self.process.close()
            self.process = None

    def _start(self) -> None:
        count = self.restarts
        try:
            process = self._start_process(count)
        except OSError as error:  # no process, memory or file is to be had: that may pass
            _log.error("node_not_started", node=self.name, reason=str(error))
            text = f"node '{self.name}' ({self.kind}) could not be started: {error}"
            if self._entry.restart == "never":
                self._give_up(text)
            else:
                self._restart_later(text, f"could not be started: {error}")
            return
        _log.info("node_started", node=self.name, kind=self.kind, pid=process.pid, restarts=count)

    def _start_process(self, restarts: int) -> NodeProcess:
        # A restarted node waits for no subscribers: the others are there, and frames do not wait.
        subscribers = 0 if restarts else self._job.subscribers
        job = msgspec.structs.replace(self._job, restarts=restarts, subscribers=subscribers)
        self.process = process = NodeProcess(self.kind, job, self._server)
        self._end_limit: ProgressLimit | None = None  # of this process, once its end is awaited
        self._detector = HangDetector(process.pid, process.heartbeat, self._launch)
        return process

    def _on_failure(self, process: NodeProcess, why: str, *, last: bool) -> None:
        text = process.describe_end() + (f" ({why})" if why else "")
        code = process.exit_code()
        _log.error("node_ended", node=self.name, why=why or "exit code", code=code)
        process.heartbeat.poll()
        failed_itself = code is not None and code > 0 and not process.was_terminated
        hopeless = failed_itself and not process.heartbeat.ready and not self.restarts
        self._hopeless |= hopeless
        if last or hopeless or self._entry.restart == "never":
            self._give_up(text)
        elif self._restart_later(text, why or process.describe_exit()):
            self.close()

    def _restart_later(self, text: str, reason: str) -> bool:
        """Note a failure; False where that was one too many."""
        delay = self._backoff.delay_s(time.monotonic())
        if delay is None:
            entry = self._entry
            times = f"{entry.max_restarts} times within {entry.window_s:g} s"
            self._give_up(f"{text}; it was restarted {times}, and is not any more")
            return False
        self._last_end, self._last_reason = text, reason
        self._due = time.monotonic() + delay
        _log.warning("node_restarts", node=self.name, in_s=delay, restarts=self.restarts)
        return True

    def _give_up(self, why: str) -> None:
        self.failure = why
        self.failed_at = time.monotonic()
