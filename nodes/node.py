"""The frame round every node: its one argument, heartbeats to the launcher, the stop request, exit codes."""

import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import msgspec
import structlog

from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.files import write_bytes
from semantic_mapper.nodes import process
from semantic_mapper.nodes.launcher.liveness import HeartbeatWriter
from semantic_mapper.nodes.options import CameraOptions, NodeJob, NodeOptions
from semantic_mapper.transport.endpoints import default_endpoint

_log = structlog.get_logger(__name__)

OptionsT = TypeVar("OptionsT", bound=NodeOptions)


@dataclass(frozen=True, slots=True)
class NodeContext:
    """Who a node is and whom it knows."""

    name: str  # of the node
    endpoints: dict[str, str]  # by node name
    subscribers: int  # how many listen to its frames
    stop: process.StopRequest  # true once somebody has requested its end
    heartbeat: HeartbeatWriter  # tells the launcher how far the node is
    restarts: int = 0  # how often its launcher has restarted it
    folder: Path | None = None  # of the launch's notes and sockets; None where it was started by hand
    restartable: bool = False  # whether it restarts where it fails

    def endpoint(self, name: str) -> str:
        """Where a node publishes; an endpoint is one already."""
        return name if "://" in name else self.endpoints.get(name) or default_endpoint(name)

    def leave_note(self, what: str, text: str) -> None:
        """Leave word to the process that takes over when this one is killed, in a launch. ``OSError``: it cannot be."""
        if self.folder is not None:
            write_bytes(self.folder / f"{self.name}.{what}.note", text.encode(), sync="none")

    def try_to_leave_note(self, what: str, text: str, then: str) -> bool:
        """As ``leave_note``; whether it was written. Else a warning says what comes of it (``then``)."""
        try:
            self.leave_note(what, text)
        except OSError as error:
            _log.warning("note_not_left", note=what, reason=str(error), then=then)
            return False
        return True

    def note(self, what: str) -> str:
        """What a process of this node has left before; empty where it is missing."""
        path = None if self.folder is None else self.folder / f"{self.name}.{what}.note"
        return path.read_text(encoding="utf-8") if path is not None and path.exists() else ""


def run_node(kind: type[OptionsT], work: Callable[[NodeContext, OptionsT], str | None]) -> NoReturn:
    """Run a node to its end and exit: 0 done (also on a stop request), 1 failed with one line that says why,
    ``EXIT_LOSS`` done, but a part of what it was to keep is lost, with one line that says what.

    In a launch only the launcher's ``STOP_SIGNAL`` asks for an end that is one: after SIGTERM or SIGINT of anybody
    else, a restartable node does what it does at its end, and exits with 128 + the signal's number.

    ``work`` does it all; it looks at ``stop`` often, and returns what is lost, in words, if anything.
    """
    process.prepare_process()
    code = 1
    try:
        if len(sys.argv) != 2:
            example = '{"name": "camera", "options": {"log": "kitchen.mcap"}}'
            raise ConfigError(f"a node takes one argument, JSON: {example}")
        job = read_job(sys.argv[1])
        structlog.contextvars.bind_contextvars(node=job.name)
        heartbeat = HeartbeatWriter(job.heartbeat_fd)
        heartbeat.start()
        options = convert_config(job.options, kind, f"node '{job.name}'")
        signals = (process.STOP_SIGNAL, signal.SIGINT, signal.SIGTERM)
        if job.restartable and kind is CameraOptions:
            # Its last words would be that the stream has ended, and its readers would end, too: it drops out instead.
            signals = (process.STOP_SIGNAL,)
            for signum in (signal.SIGINT, signal.SIGTERM):
                signal.signal(signum, signal.SIG_DFL)
        with process.StopRequest(patient=True, signals=signals) as stop:
            folder = Path(job.folder) if job.folder else None
            launched = (job.restarts, folder, job.restartable)
            losses = work(NodeContext(job.name, job.endpoints, job.subscribers, stop, heartbeat, *launched), options)
            # A request that comes from here on finds a process that ends anyway, and must not hide how it ended.
            signal.signal(process.STOP_SIGNAL, signal.SIG_IGN)
        code = stop.exit_code if job.heartbeat_fd >= 0 else 0
        if losses and not code:
            _log.error(process.LOSS_EVENT, lost=losses)
            code = process.EXIT_LOSS
    except SemanticMapperError as error:
        _log.error(process.FAILURE_EVENT, error=str(error))
    except Exception as error:
        if not (message := process.failure_message(error)):
            raise
        _log.error(process.FAILURE_EVENT, error=message)
    sys.exit(code)


def read_job(argument: str) -> NodeJob:
    """What a node is to do, of JSON, or "fd:N" of an open file with it; ``ConfigError`` where it is neither."""
    text: str | bytes = argument
    try:
        if argument.startswith(process.JOB_PREFIX):
            with open(int(argument.removeprefix(process.JOB_PREFIX)), "rb") as file:
                text = file.read()
        plain = msgspec.json.decode(text)
    except (ValueError, OSError) as error:
        raise ConfigError(f"the argument of a node must be JSON, or fd:N of an open file with it: {error}") from error
    return convert_config(plain, NodeJob, "argument of the node")
