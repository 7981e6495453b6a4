"""The launcher's own status topic: how each node is, as it says itself and as its launcher sees it, in one place."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import structlog
from msgspec.structs import replace

from semantic_mapper.errors import CodecError, TransportError
from semantic_mapper.nodes.public_publisher import PublicPublisher
from semantic_mapper.nodes.supervisor.hang_detector import process_stats
from semantic_mapper.nodes.supervisor.launch_config import STATUS_SOCKET
from semantic_mapper.nodes.supervisor.managed_process import ManagedProcess
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.messages import NodeState, Status
from semantic_mapper.transport.sockets import NewestSubscriber

PERIOD_S = 0.5
MAX_SENTENCE, MAX_SENTENCES = 400, 32  # last words of a node may be long

_log = structlog.get_logger(__name__)


class LaunchStatus:
    """Publishes a ``Status`` of each node, and one of the launch itself. A context manager.

    Counters and ages of a node's own status are passed on (a player of logs has none: its launcher counts ``published``
    frames). Added are ``pid``, ``restarts``, ``rss_kb``, ``cpu_ms``, ``fds`` and ``threads``, and the ages ``start``
    (of the process), ``beat`` (last heartbeat), ``turn`` (of its main loop) and ``status`` (of its own status).

    Args:
        endpoints: Of the nodes and, under ``STATUS_SOCKET``, of this topic.
        nodes: Names of those that may publish a status.
        public, keys: A second endpoint for it, see ``PublicPublisher``.

    Raises:
        TransportError: the endpoint cannot be bound.
    """

    def __init__(self, endpoints: Mapping[str, str], nodes: Sequence[str], public: str = "", keys: str = "") -> None:
        self._began = time.monotonic()
        self._reported_at = 0.0
        self._own: dict[str, Status] = {}
        self._publisher = PublicPublisher(endpoints[STATUS_SOCKET], public, keys, linger_ms=200)
        self._subscriber = NewestSubscriber([endpoints[name] for name in nodes], ("status",))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the sockets. Harmless when repeated."""
        self._subscriber.close()
        self._publisher.close()

    def report(self, processes: Sequence[ManagedProcess], state: NodeState, *, now: bool = False) -> None:
        """Publish, if it is time to."""
        if not now and time.monotonic() - self._reported_at < PERIOD_S:
            return
        self._reported_at = time.monotonic()
        while (message := self._subscriber.receive(0.0)) is not None:
            if isinstance(message, Status):
                self._own[message.node] = message
        statuses = [node_status(managed, self._own.get(managed.name)) for managed in processes]
        for status in (*statuses, self._of_launch(processes, statuses, state)):
            self._publish(status)

    def _publish(self, status: Status) -> None:
        """What cannot be published is no reason to end a launch."""
        short = tuple(sentence[:MAX_SENTENCE] for sentence in status.degraded[:MAX_SENTENCES])
        try:
            self._publisher.publish(encode(replace(status, degraded=short)))
        except (CodecError, TransportError) as error:
            _log.warning("status_not_told", node=status.node, reason=str(error))

    def _of_launch(self, processes: Sequence[ManagedProcess], statuses: Sequence[Status], state: NodeState) -> Status:
        degraded = tuple(f"node '{s.node}' is not well" for s in statuses if s.degraded)
        counters = {"pid": os.getpid(), "nodes": len(processes), "restarts": sum(m.restarts for m in processes)}
        return Status(
            node=STATUS_SOCKET,
            state="degraded" if degraded and state == "running" else state,
            stamp_ns=time.monotonic_ns(),
            counters=counters | process_stats(os.getpid()),
            ages_s={"start": time.monotonic() - self._began},
            degraded=degraded,
        )


def node_status(managed: ManagedProcess, own: Status | None) -> Status:
    """What a node says of itself (unless the process that said it is gone) and what its launcher knows."""
    now = time.monotonic_ns()
    counters = {"restarts": managed.restarts}
    ages: dict[str, float] = {}
    degraded = managed.warnings
    if managed.process is not None:
        beat = managed.process.heartbeat
        ages |= {"start": beat.age_s, "beat": beat.silent_s}
        if beat.stalled_s is not None:
            ages["turn"] = beat.stalled_s
        counters |= {"pid": managed.process.pid} | process_stats(managed.process.pid)
        if beat.frame_age_s is not None:
            counters["published"], ages["frame"] = beat.frames, beat.frame_age_s
        if own is not None and (now - own.stamp_ns) / 1e9 <= beat.age_s:
            said_s = (now - own.stamp_ns) / 1e9
            ages = {name: age + said_s for name, age in own.ages_s.items()} | ages | {"status": said_s}
            counters = dict(own.counters) | counters
            degraded += own.degraded
    state: NodeState = "degraded" if degraded and managed.state == "running" else managed.state
    return Status(managed.name, state, now, counters, ages, degraded)
