"""One node of a launch: its process, and the one after it where that one fails."""

from __future__ import annotations

import math
import time

import msgspec
import structlog

from semantic_mapper.nodes.options import Call, NodeJob
from semantic_mapper.nodes.supervisor.backoff import Restarts
from semantic_mapper.nodes.supervisor.launch_config import Launch, NodeEntry
from semantic_mapper.nodes.supervisor.node_process import KILL_S, Child
from semantic_mapper.transport.messages import NodeState

EDGE_SILENCE_S = 30.0  # loading packages may hold all threads up, and so may a machine with too much to do
ORPHAN_S = 120  # see ``NodeJob.orphan_s``

_log = structlog.get_logger(__name__)


class Member:
    """A node over all its restarts. Starts at once.

    Args:
        entry: Of the launch file.
        launch: For its options and limits.
        endpoints: Of all nodes.
        folder: Of the launch.
    """

    def __init__(self, entry: NodeEntry, launch: Launch, endpoints: dict[str, str], folder: str) -> None:
        self.name = entry.name
        self.kind = entry.kind
        self._entry = entry
        self._launch = launch
        self._job = NodeJob(
            name=entry.name,
            options=msgspec.to_builtins(launch.options[entry.name]),
            endpoints=endpoints,
            subscribers=launch.listeners(entry.name),
            folder=folder,
            comes_back=entry.restart != "never",
            # The kernel ends what is silent for so long; before, it is the launcher's turn.
            orphan_s=math.ceil(max(ORPHAN_S, 2 * launch.heartbeat_s, 2 * EDGE_SILENCE_S)),
        )
        self._restarts = Restarts(entry)
        self._due = 0.0  # of the next start, while there is no process
        self._last_end = self._last_reason = ""
        self.failure = ""  # why it is not started any more
        self.failed_at = 0.0
        self.child: Child | None = None
        self._standby: Child | None = None
        self._standby_due = 0.0
        self._finishes = self._hopeless = False
        self._start()

    @property
    def restarts(self) -> int:
        """How often it was started anew."""
        return self._restarts.count

    @property
    def runs(self) -> bool:
        """Whether it has a process, or is about to have one."""
        if self.child is None or self.child.has_failed():  # not given up before ``look_after`` says so
            return not self.failure
        return self.child.exit_code() is None

    @property
    def state(self) -> NodeState:
        """Where it is in its life, as far as its launcher can tell."""
        if self.child is None:
            return "ended" if self.failure else "starting"
        if self.child.exit_code() is not None:
            return "ended"
        if self.child.asked_to_stop or self.child.pulse.ending:
            return "stopping"
        return "running" if self.child.pulse.ready else "starting"

    @property
    def troubles(self) -> tuple[str, ...]:
        """What happened to it lately."""
        if self.failure:
            return (self.failure,)
        lately = self._restarts.lately(time.monotonic())
        if not lately:
            return ()
        times = "once" if lately == 1 else f"{lately} times"
        return (f"restarted {times} in the last {self._entry.window_s:g} s; the last time: {self._last_reason}",)

    def look_after(self, *, last: bool, calm: bool = False) -> None:
        """Start it if it is time to; find out whether it has failed or hangs.

        Args:
            last: The launch ends: what fails now is not started any more.
            calm: All nodes run: the time to have a process in waiting, which takes a core for some seconds.
        """
        if self.child is None:
            if last and not self.failure:
                self._give_up(f"{self._last_end}; it had not been restarted yet when the launch ended")
            elif not self.failure and time.monotonic() >= self._due:
                self._start()
            return
        if self.child.exit_code() is None:
            why = self._find_hang(self.child)
            if not why:
                if calm and not last and self._entry.standby:
                    self._keep_standby()
                return
            self.child.kill()
            self.child.wait(KILL_S)
            self._on_failure(self.child, why, last=last)
        elif last and self.child.sent_away:
            self.child.ask_to_stop()  # it only went before it was asked to: whoever ends us may have told all of us
        elif self.child.has_failed() and not self.failure:
            self._on_failure(self.child, "", last=last)

    def overstay(self, patience_s: float) -> None:
        """End a process that has not ended when it should have; that is a failure."""
        if self.child is None or self.child.exit_code() is not None:
            return
        self.child.ask_to_stop()
        if not self.child.wait(KILL_S):
            self.child.kill()
            self.child.wait(KILL_S)
        self._on_failure(self.child, f"it did not end within {patience_s:g} s", last=True)

    def ask_to_stop(self) -> None:
        """Ask its process, if there is one."""
        if self.child is None or (self._finishes and not self.child.pulse.ready):  # the request would end it at once
            return
        self.child.ask_to_stop()

    def start_to_finish(self) -> None:
        """Start a node that is given up once more, to be stopped: it writes results of what it saved."""
        if not self.failure or self._finishes or self._hopeless or self._entry.restart == "never":
            return
        self._finishes = True
        restarts = self.restarts + 1  # it goes on from what this launch saved
        job = msgspec.structs.replace(self._job, restarts=restarts, subscribers=0)
        try:
            child = self._wake_standby(restarts) or Child(self.kind, job)
        except OSError as error:
            _log.error("results_not_written", node=self.name, reason=str(error))
            return
        if self.child is not None:
            self.child.close()
        self.child = child
        _log.info("node_finishes", node=self.name, pid=child.pid)

    def close(self) -> None:
        """Leave no process behind."""
        for child in (self.child, self._standby):
            if child is not None:
                child.close()
        self.child = self._standby = None

    def _start(self) -> None:
        count = self._restarts.count
        # What replaces a dead node waits for nobody: the others are there, and frames do not wait.
        job = msgspec.structs.replace(self._job, restarts=count, subscribers=0 if count else self._job.subscribers)
        try:
            self.child = self._wake_standby(count) or Child(self.kind, job)
        except OSError as error:  # no process, memory or file is to be had: that may pass
            _log.error("node_not_started", node=self.name, reason=str(error))
            text = f"node '{self.name}' ({self.kind}) could not be started: {error}"
            if self._entry.restart == "never":
                self._give_up(text)
            else:
                self._restart_later(text, f"could not be started: {error}")
            return
        _log.info("node_started", node=self.name, kind=self.kind, pid=self.child.pid, restarts=count)

    def _keep_standby(self) -> None:
        """Have a process in waiting; not again and again where it cannot live."""
        if self._standby is not None and self._standby.exit_code() is None:
            return
        if self._entry.restart == "never" or time.monotonic() < self._standby_due:
            return
        if self._standby is not None:
            self._standby.close()
            self._standby = None
        self._standby_due = time.monotonic() + self._entry.backoff_max_s
        try:
            self._standby = Child(self.kind, msgspec.structs.replace(self._job, subscribers=0, waits=True))
        except OSError as error:  # the node at work does without
            again_s = self._entry.backoff_max_s
            _log.warning("standby_not_started", node=self.name, reason=str(error), again_s=again_s)
            return
        _log.info("standby_started", node=self.name, pid=self._standby.pid)

    def _wake_standby(self, restarts: int) -> Child | None:
        """The process that has waited, now at work; None where there is none that could."""
        child, self._standby = self._standby, None
        if child is None:
            return None
        try:
            child.begin(Call(restarts=restarts))
        except OSError:
            child.close()
            return None
        self._standby_due = 0.0
        return child

    def _find_hang(self, child: Child) -> str:
        """Why a running process has to be killed; empty where it need not."""
        pulse, limits = child.pulse, self._launch
        pulse.listen()
        if pulse.silent_s > limits.heartbeat_s / 2:
            child.stillness.watch()
        else:
            child.stillness.forget()
        still = pulse.ready and not pulse.ending and pulse.silent_s > limits.heartbeat_s and child.stillness.proven
        silence = limits.heartbeat_s if still else max(limits.heartbeat_s, EDGE_SILENCE_S)
        if pulse.silent_s > silence:
            return f"it gave no sign of life for {silence:g} s and was killed"
        if not pulse.ready and not child.asked_to_stop and pulse.age_s > limits.start_s:
            return f"it was not ready after {limits.start_s:g} s and was killed"
        if pulse.stalled_s is not None and pulse.stalled_s > limits.stall_s:
            return f"its main loop made no turn for {limits.stall_s:g} s, and it was killed"
        return ""

    def _on_failure(self, child: Child, why: str, *, last: bool) -> None:
        text = child.describe_end() + (f" ({why})" if why else "")
        code = child.exit_code()
        _log.error("node_ended", node=self.name, why=why or "exit code", code=code)
        child.pulse.listen()
        fell = code is not None and code > 0 and not child.sent_away  # by itself
        hopeless = fell and not child.pulse.ready and not self.restarts
        self._hopeless |= hopeless
        if last or hopeless or self._entry.restart == "never":
            self._give_up(text)
            return
        if self._restart_later(text, why or child.end()):
            child.close()
            self.child = None

    def _restart_later(self, text: str, reason: str) -> bool:
        """Note a failure; False where that was one too many."""
        delay = self._restarts.delay_s(time.monotonic())
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
