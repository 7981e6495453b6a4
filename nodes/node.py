"""The frame round every node: its one argument, signs of life to the launcher, the stop request, exit codes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn, TypeVar

import msgspec
import structlog

from nodes.child import FAILURE_EVENT
from nodes.options import NodeJob, NodeOptions
from nodes.process import StopRequest, prepare_process
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError, SemanticMapperError

BEAT_PERIOD_S = 0.5

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
    """

    name: str
    endpoints: dict[str, str]
    subscribers: int
    stop: StopRequest

    def endpoint(self, name: str) -> str:
        """Where a node publishes."""
        if name in self.endpoints:
            return self.endpoints[name]
        from semantic_mapper.transport.endpoints import default_endpoint

        return default_endpoint(name)


def run_node(kind: type[OptionsT], work: Callable[[NodeContext, OptionsT], None]) -> NoReturn:
    """Run a node to its end and exit: 0 done (also when asked to stop), 1 failed with one line that says why.

    Args:
        kind: Of its options.
        work: Does it all; looks at ``stop`` often.
    """
    prepare_process()
    code = 1
    try:
        job = _read_job()
        structlog.contextvars.bind_contextvars(node=job.name)
        if job.heartbeat_fd >= 0:
            threading.Thread(target=_beat, args=(job.heartbeat_fd, job.orphan_s), daemon=True).start()
        options = convert_config(job.options, kind, f"node '{job.name}'")
        with StopRequest(patient=True) as stop:
            work(NodeContext(job.name, job.endpoints, job.subscribers, stop), options)
        code = 0
    except (SemanticMapperError, OSError) as error:
        _log.error(FAILURE_EVENT, error=str(error))
    sys.exit(code)


def _read_job() -> NodeJob:
    if len(sys.argv) != 2:
        raise ConfigError('a node takes one argument, JSON: {"name": "camera", "options": {"log": "kitchen.mcap"}}')
    try:
        plain = msgspec.json.decode(sys.argv[1])
    except msgspec.DecodeError as error:
        raise ConfigError(f"the argument of a node must be JSON: {error}") from error
    return convert_config(plain, NodeJob, "argument of the node")


def _beat(fd: int, orphan_s: int) -> None:
    """Tell the launcher that this process lives; when there is no launcher any more, end."""
    os.set_blocking(fd, False)
    pause = threading.Event()
    while True:
        try:
            os.write(fd, b".")
        except BlockingIOError:  # the launcher is stopped; its pipe is full
            pass
        except OSError:
            _end_orphan(orphan_s)
            return
        pause.wait(BEAT_PERIOD_S)


def _end_orphan(orphan_s: int) -> None:
    """Ask ourselves to stop; the kernel sees to it that nothing outlives its time, even where Python hangs."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # the launcher read these
    os.dup2(nowhere, 2)
    signal.alarm(orphan_s)
    os.kill(os.getpid(), signal.SIGTERM)
