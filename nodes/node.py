"""The frame round every node: its one argument, signs of life to the launcher, the stop request, exit codes."""

from __future__ import annotations

import importlib
import select
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn, TypeVar

import msgspec
import structlog

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.memory import is_out_of_memory, memory_message
from semantic_mapper.nodes.options import Call, CameraOptions, NodeJob, NodeOptions
from semantic_mapper.nodes.process import STOP_SIGNAL, StopRequest, prepare_process
from semantic_mapper.nodes.supervisor.heartbeat import Heart, end_with_launcher
from semantic_mapper.nodes.supervisor.node_process import FAILURE_EVENT, JOB_PREFIX

_log = structlog.get_logger(__name__)

OptionsT = TypeVar("OptionsT", bound=NodeOptions)


@dataclass(frozen=True, slots=True)
class NodeContext:
    """Who a node is and whom it knows.

    Args:
        name: Of the node.
        endpoints: By node name.
        subscribers: How many listen to its frames.
        stop: True once somebody has asked it to end.
        heart: Tells the launcher how far the node is.
        restarts: How often its launcher has started it anew.
        folder: Of the launch's notes and sockets; None where it was started by hand.
        comes_back: Whether it is started anew where it fails.
        waits: Whether it is kept in waiting, in case that the node fails; see ``await_turn``.
    """

    name: str
    endpoints: dict[str, str]
    subscribers: int
    stop: StopRequest
    heart: Heart
    restarts: int = 0
    folder: Path | None = None
    comes_back: bool = False
    waits: bool = False

    def await_turn(self) -> NodeContext:
        """A process in waiting stays in here until it is needed, and ends where it never is; any other goes on at once.

        To be called when all is prepared that needs neither sockets of its own nor what the node before it has left.

        Returns:
            The context to work with from now on.
        """
        if not self.waits:
            return self
        if not self.called():
            _log.info("waiting")
        line = sys.stdin.buffer.readline()
        if not line:
            sys.exit(0)
        self.heart.outlive_launcher()
        call = convert_config(msgspec.json.decode(line), Call, "call of a node that waits")
        return replace(self, waits=False, restarts=call.restarts)

    def called(self) -> bool:
        """Whether a process in waiting is needed now, or never will be: ``await_turn`` returns at once."""
        return not self.waits or bool(select.select([sys.stdin], [], [], 0)[0])

    def endpoint(self, name: str) -> str:
        """Where a node publishes."""
        if name in self.endpoints:
            return self.endpoints[name]
        from semantic_mapper.transport.endpoints import default_endpoint

        return default_endpoint(name)

    def leave_note(self, what: str, text: str) -> None:
        """Leave word to the process that takes over when this one is killed; in a launch only.

        Raises:
            OSError: it cannot be written.
        """
        if self.folder is not None:
            draft = self.folder / f"{self.name}.{what}.new"
            draft.write_text(text, encoding="utf-8")
            draft.replace(self.folder / f"{self.name}.{what}.note")

    def try_to_leave_note(self, what: str, text: str, then: str) -> bool:
        """As ``leave_note``, for those who go on where it cannot be written.

        Args:
            what: As there.
            text: As there.
            then: What comes of it, for people.

        Returns:
            Whether it was written.
        """
        try:
            self.leave_note(what, text)
        except OSError as error:
            _log.warning("note_not_left", note=what, reason=str(error), then=then)
            return False
        return True

    def note(self, what: str) -> str:
        """What a process of this node has left before; empty where there is none."""
        path = None if self.folder is None else self.folder / f"{self.name}.{what}.note"
        return path.read_text(encoding="utf-8") if path is not None and path.exists() else ""


def run_node(
    kind: type[OptionsT],
    work: Callable[[NodeContext, OptionsT], None],
    packages: Sequence[str] = (),
) -> NoReturn:
    """Run a node to its end and exit: 0 done (also when asked to stop), 1 failed with one line that says why.

    In a launch only the launcher's ``STOP_SIGNAL`` asks for an end that is one: after SIGTERM or SIGINT of anybody
    else, a node that comes back does what it does at its end, and exits with 128 + the signal's number.

    Args:
        kind: Of its options.
        work: Does it all; looks at ``stop`` often, and calls ``await_turn`` once.
        packages: Modules that ``work`` imports; a process that is kept in waiting imports them before.
    """
    prepare_process()
    code = 1
    try:
        job = _read_job()
        structlog.contextvars.bind_contextvars(node=job.name)
        heart = Heart(job.heartbeat_fd, job.orphan_s)
        heart.start()
        if job.waits:
            end_with_launcher()
            for name in packages:
                importlib.import_module(name)
        options = convert_config(job.options, kind, f"node '{job.name}'")
        with StopRequest(patient=True, signals=_requests(job, kind)) as stop:
            folder = Path(job.folder) if job.folder else None
            work(
                NodeContext(
                    job.name,
                    job.endpoints,
                    job.subscribers,
                    stop,
                    heart,
                    job.restarts,
                    folder,
                    job.comes_back,
                    job.waits,
                ),
                options,
            )
        code = stop.exit_code if job.heartbeat_fd >= 0 else 0
    except SemanticMapperError as error:
        _log.error(FAILURE_EVENT, error=str(error))
    except Exception as error:
        if is_out_of_memory(error):  # native packages raise whatever they like then
            _log.error(FAILURE_EVENT, error=memory_message(error))
        elif isinstance(error, OSError):
            _log.error(FAILURE_EVENT, error=str(error))
        else:
            raise
    sys.exit(code)


def _requests(job: NodeJob, kind: type[NodeOptions]) -> tuple[signal.Signals, ...]:
    """Signals that ask a node to end in order."""
    if job.comes_back and kind is CameraOptions:
        # Its last words would be that the stream has ended, and its readers would end with it: it drops out instead.
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, signal.SIG_DFL)
        return (STOP_SIGNAL,)
    return (STOP_SIGNAL, signal.SIGINT, signal.SIGTERM)


def _read_job() -> NodeJob:
    if len(sys.argv) != 2:
        raise ConfigError('a node takes one argument, JSON: {"name": "camera", "options": {"log": "kitchen.mcap"}}')
    told: str | bytes = sys.argv[1]
    try:
        if told.startswith(JOB_PREFIX):
            with open(int(told.removeprefix(JOB_PREFIX)), "rb") as file:
                told = file.read()
        plain = msgspec.json.decode(told)
    except (ValueError, OSError) as error:
        raise ConfigError(f"the argument of a node must be JSON, or fd:N of an open file with it: {error}") from error
    return convert_config(plain, NodeJob, "argument of the node")
