"""The processes of a launch: one table of their kinds, one process, and one node over all its restarts."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import ExitStack

import msgspec
import structlog

from semantic_mapper.nodes.launcher.launch_file import Launch, NodeEntry
from semantic_mapper.nodes.launcher.liveness import BUSY_SILENCE_S, HeartbeatMonitor, ProgressLimit, cpu_seconds
from semantic_mapper.nodes.options import NodeJob
from semantic_mapper.nodes.process import EXIT_LOSS, FAILURE_EVENT, JOB_PREFIX, LOSS_EVENT, STOP_SIGNAL
from semantic_mapper.plain_text import counted, visible, without_secrets
from semantic_mapper.transport.messages import NodeState

FINISH_S = 300.0  # of nodes that write a map or weights
KILL_S = 5.0  # between the request to end and SIGKILL, and between SIGKILL and the end
TAIL_LINES = 12
SYSTEMD_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")  # for the launcher alone, not for its nodes
# Of a process that somebody has requested to end, whether or not it was old enough to do so in order.
TERMINATED = {code: s for s in (signal.SIGTERM, signal.SIGINT) for code in (128 + s, -s)}
# Pauses before restarts: doubled with each failure in the window.
BACKOFF_S, BACKOFF_MAX_S, WINDOW_S = 0.1, 10.0, 60.0

_log = structlog.get_logger(__name__)


# How long each kind of node may make no progress when it is to end; one that makes progress, be it slowly, may take as
# long as it needs. In the order in which they are stopped: sources first, so that the others get the end of the stream.
STOP_S = {"camera": 15.0, "finetuner": FINISH_S, "foxglove": 15.0, "recorder": 15.0, "mapper": FINISH_S}


class NodeProcess:
    """A running node, in an interpreter of its own. Its stderr is passed on line by line, marked with its name.

    ``job`` is what it is to do (``heartbeat_fd`` is filled in here). Raises OSError, RuntimeError: no process, thread,
    file or memory is to be had; nothing is left behind.
    """

    def __init__(self, kind: str, job: NodeJob, heartbeat_s: float = BUSY_SILENCE_S) -> None:
        self.name = job.name
        self.kind = kind
        self.tail: deque[str] = deque(maxlen=TAIL_LINES)
        self.stop_requested = False
        with ExitStack() as ours, ExitStack() as theirs:
            self._beats, beats = os.pipe()
            ours.callback(os.close, self._beats)
            theirs.callback(os.close, beats)
            # Arguments are seen by all users (``ps``), and a camera's address may hold a password.
            given = theirs.enter_context(open(os.memfd_create("job"), "w+b"))
            given.write(msgspec.json.encode(msgspec.structs.replace(job, heartbeat_fd=beats)))
            given.seek(0)
            self._process = _start_interpreter(kind, given.fileno(), beats)
            ours.callback(self._end)
            self.pid = self._process.pid
            self.heartbeat = HeartbeatMonitor(self._beats, self.pid, heartbeat_s)
            self._reader = threading.Thread(target=self._pass_on, name=f"stderr of {self.name}", daemon=True)
            self._reader.start()
            ours.pop_all()

    def exit_code(self) -> int | None:
        """None while it runs; negative: the signal that ended it."""
        return self._process.poll()

    def has_failed(self) -> bool:
        """Ended otherwise than well; our request may hit a process that is too young to handle it."""
        code = self.exit_code()
        if code in (None, 0, EXIT_LOSS):
            return False
        return not self.stop_requested or (code != -STOP_SIGNAL and not self.was_terminated)

    @property
    def was_terminated(self) -> bool:
        """Whether SIGTERM or SIGINT ended it, which the launcher never sends."""
        return self.exit_code() in TERMINATED

    def request_stop(self) -> None:
        """``STOP_SIGNAL``, once; no matter if it has ended already."""
        if not self.stop_requested:
            self.stop_requested = True
            self._process.send_signal(STOP_SIGNAL)

    def kill(self) -> None:
        """SIGKILL; no matter if it has ended already."""
        self._process.kill()

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends within the time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Kill it if it still runs, and free what belongs to it."""
        self._end()
        self._reader.join(timeout=2.0)  # a grandchild could keep the pipe open
        os.close(self._beats)

    def describe_exit(self) -> str:
        """Exit code or signal."""
        code = self.exit_code()
        if code in TERMINATED:
            return f"sent away by {TERMINATED[code].name} from outside the launch"
        return f"exit code {code}" if code is None or code >= 0 else f"killed by {signal.Signals(-code).name}"

    def describe_end(self) -> str:
        """How it ended, with its last words."""
        self._reader.join(timeout=2.0)
        lines = [line for line in self.tail if line.strip()]
        # A node that knows why it fails says so in one line; of any other end, all the last lines may tell.
        known = [line for line in lines if FAILURE_EVENT in line or LOSS_EVENT in line]
        words = " | ".join(known or lines)
        end = f"node '{self.name}' ({self.kind}) ended: {self.describe_exit()}"
        return end + (f"; its last words: {words}" if words else "")

    def _end(self) -> None:
        self.kill()
        if not self.wait(KILL_S):  # in the kernel, for a device or a disk that does not answer
            _log.error("node_does_not_die", node=self.name, pid=self.pid)

    def _pass_on(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            for raw in stream:
                line = visible(without_secrets(raw.decode(errors="replace").rstrip("\n")))
                self.tail.append(line)
                try:
                    sys.stderr.write(f"[{self.name}] {line}\n")
                    sys.stderr.flush()
                except (OSError, ValueError):  # nobody reads our stderr any more; the tail is still kept
                    continue


def _start_interpreter(kind: str, job: int, heartbeat: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        # -I: a sourced workspace on PYTHONPATH, or a file in the current folder, cannot shadow our modules.
        [sys.executable, "-I", "-m", "semantic_mapper.nodes", kind, f"{JOB_PREFIX}{job}"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        pass_fds=(heartbeat, job),
        env={name: value for name, value in os.environ.items() if name not in SYSTEMD_VARIABLES},
        process_group=0,  # Ctrl-C in the terminal reaches the launcher only, which then stops all in order
    )


class ManagedProcess:
    """Starts a node at once, and again where it fails and its launch file says so."""

    def __init__(self, entry: NodeEntry, launch: Launch, endpoints: dict[str, str], folder: str) -> None:
        self.name = entry.name
        self.kind = entry.kind
        self.process: NodeProcess | None = None
        self.failure = ""  # why it is not started any more
        self.failed_at = 0.0
        self._restarts = entry.restart != "never"
        self._heartbeat_s = launch.file.heartbeat_s
        self._job = NodeJob(
            name=entry.name,
            options=msgspec.to_builtins(launch.options[entry.name]),
            endpoints=endpoints,
            subscribers=launch.listeners(entry.name),
            folder=folder,
            restartable=self._restarts,
        )
        self.restarts = 0
        self._failures: list[float] = []  # monotonic seconds, those in the window
        self._due = 0.0  # of the next start, while there is no process
        self._last_end = self._last_reason = ""
        self._finishing = self._hopeless = False
        self._start()

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
        if self.process.stop_requested or self.process.heartbeat.ending:
            return "stopping"
        return "running" if self.process.heartbeat.ready else "starting"

    @property
    def loss(self) -> str:
        """What a node that has ended in order has lost, with its last words; empty = nothing that it knows of."""
        has_lost = self.process is not None and self.process.exit_code() == EXIT_LOSS
        return self.process.describe_end() if self.process is not None and has_lost else ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What happened to it recently."""
        if self.failure or self.loss:
            return (self.failure or self.loss,)
        recent = self._recent_failures()
        if not recent:
            return ()
        times = counted(recent, "time")
        return (f"restarted {times} in the last {WINDOW_S:g} s; the last time: {self._last_reason}",)

    def look_after(self, *, last: bool) -> None:
        """Start it if it is time to; find out whether it has failed or hangs. Where the launch ends (``last``), what
        fails now is not started any more."""
        if self.process is None:
            if last and not self.failure:
                self._give_up(f"{self._last_end}; it had not been restarted yet when the launch ended")
            elif not self.failure and time.monotonic() >= self._due:
                self._start()
        elif self.process.exit_code() is None:
            if hang := self.process.heartbeat.find_hang(stopping=self.process.stop_requested):
                self._kill(self.process, hang, last=last)
        elif last and self.process.was_terminated:
            self.process.request_stop()  # the process that ends us may have sent the signal to all of us
        elif self.process.has_failed() and not self.failure:
            self._on_failure(self.process, "", last=last)

    def makes_progress(self, limit_s: float) -> bool:
        """Whether it comes nearer to its end, within ``limit_s`` without progress; to be called often while that is
        awaited. Once it writes its results, turns are progress, too."""
        if self.process is None:
            return self.runs
        if self._end_limit is None:
            pid = self.process.pid
            self._end_limit = ProgressLimit(limit_s, lambda: cpu_seconds(pid))
        beat = self.process.heartbeat
        return self.runs and not self._end_limit.exceeded(beat.turns if beat.ending else -1)

    def kill_overdue(self, limit_s: float) -> None:
        """End a process that has not ended when it should have; that is a failure."""
        if self.process is None or self.process.exit_code() is not None:
            return
        self.process.request_stop()
        self.process.wait(KILL_S)
        self._kill(self.process, f"it did not end, and made no progress for {limit_s:g} s", last=True)

    def request_stop(self) -> None:
        """Of its process, if there is one."""
        if self.process is None or (self._finishing and not self.process.heartbeat.ready):  # it would end at once
            return
        self.process.request_stop()

    def start_to_finish(self) -> None:
        """Start a node that is given up once more, to be stopped: it writes results of what it saved."""
        if not self.failure or self._finishing or self._hopeless or not self._restarts:
            return
        self._finishing = True
        before = self.process
        try:
            process = self._start_process(self.restarts + 1)  # it goes on from what this launch saved
        except (OSError, RuntimeError) as error:
            _log.error("results_not_written", node=self.name, reason=str(error))
            return
        if before is not None:
            before.close()
        _log.info("node_finishes", node=self.name, pid=process.pid)

    def close(self) -> None:
        """Leave no process behind."""
        if self.process is not None:
            self.process.close()
            self.process = None

    def _recent_failures(self) -> int:
        self._failures = [failed for failed in self._failures if failed > time.monotonic() - WINDOW_S]
        return len(self._failures)

    def _start(self) -> None:
        try:
            process = self._start_process(self.restarts)
        except (OSError, RuntimeError) as error:  # no process, memory or file is to be had: that may pass
            _log.error("node_not_started", node=self.name, reason=str(error))
            reason = f"could not be started: {error}"
            self._restart_or_give_up(f"node '{self.name}' ({self.kind}) {reason}", reason, restart=self._restarts)
            return
        _log.info("node_started", node=self.name, kind=self.kind, pid=process.pid, restarts=self.restarts)

    def _start_process(self, restarts: int) -> NodeProcess:
        # A restarted node waits for no subscribers: the others are there, and frames do not wait.
        subscribers = 0 if restarts else self._job.subscribers
        job = msgspec.structs.replace(self._job, restarts=restarts, subscribers=subscribers)
        self.process = process = NodeProcess(self.kind, job, self._heartbeat_s)
        self._end_limit: ProgressLimit | None = None  # of this process, once its end is awaited
        return process

    def _kill(self, process: NodeProcess, why: str, *, last: bool) -> None:
        process.kill()
        process.wait(KILL_S)
        self._on_failure(process, why, last=last)

    def _on_failure(self, process: NodeProcess, why: str, *, last: bool) -> None:
        text = process.describe_end() + (f" ({why})" if why else "")
        code = process.exit_code()
        _log.error("node_ended", node=self.name, why=why or "exit code", code=code)
        process.heartbeat.poll()
        failed_itself = code is not None and code > 0 and not process.was_terminated
        hopeless = failed_itself and not process.heartbeat.ready and not self.restarts
        self._hopeless |= hopeless
        restart = self._restarts and not (last or hopeless)
        self._restart_or_give_up(text, why or process.describe_exit(), restart=restart)
        if restart:
            self.close()

    def _restart_or_give_up(self, text: str, reason: str, *, restart: bool) -> None:
        if not restart:
            self._give_up(text)
            return
        delay = min(BACKOFF_MAX_S, BACKOFF_S * 2.0 ** self._recent_failures())
        self._failures.append(time.monotonic())
        self.restarts += 1
        self._last_end, self._last_reason = text, reason
        self._due = time.monotonic() + delay
        _log.warning("node_restarts", node=self.name, in_s=delay, restarts=self.restarts)

    def _give_up(self, why: str) -> None:
        self.failure = why
        self.failed_at = time.monotonic()
