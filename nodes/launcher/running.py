"""What a launch says of itself: its note, and how its nodes are; ``transport.launches`` finds those that run."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from semantic_mapper.errors import TransportError
from semantic_mapper.files import write_bytes
from semantic_mapper.nodes.console import table
from semantic_mapper.nodes.launcher.launch_file import Launch
from semantic_mapper.plain_text import plain_without_secrets, visible
from semantic_mapper.replay.summary import dig
from semantic_mapper.transport.launches import NOTE, STATUS_SOCKET
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import NewestSubscriber

START_S = 180.0  # how long nodes may take to start
LISTEN_S = 0.5
ANSWER_S = 5.0  # how long the launcher may take to say anything
RATE_WINDOW_S = 5.0  # over which rates are taken, where so much has been seen
RATE_LEAST_S = 2.0  # nodes tell their totals once a second
_KEPT = 64  # statuses a node


def leave_launch_note(launch: Launch, folder: Path) -> None:
    """Write the note of a launch (``LaunchNote``) into its folder, as it may stand in every recording."""
    options = plain_without_secrets(msgspec.to_builtins(launch.options))
    for keys in (o for o in options.values() if o.get("keys")):  # who reads it may be in another folder
        keys["keys"] = str(Path(keys["keys"]).expanduser().absolute())
    nodes = [msgspec.structs.replace(n, options=options[n.name]) for n in launch.nodes]
    text = msgspec.json.format(msgspec.json.encode({"launch": launch.name, "nodes": nodes}), indent=1)
    write_bytes(folder / NOTE, text, sync="none")


def node_endpoints(folder: Path) -> dict[str, str]:
    """Where the nodes of a running launch that have not ended publish, by name, as soon as all have said that they run.
    Raises TransportError: the launcher says nothing, or not all nodes have come to run in time."""
    known: dict[str, Status] = {}
    deadline = time.monotonic() + START_S
    status = f"ipc://{folder}/{STATUS_SOCKET}"
    with NewestSubscriber(status, ("status",)) as subscriber:
        while not _all_ready(known):
            message = subscriber.receive(LISTEN_S)
            if isinstance(message, Status):
                known[message.node] = message
            if time.monotonic() > deadline:
                raise TransportError(f"{status}: not all nodes have come to run in {START_S:g} s; see `view --status`")
    running = sorted(name for name, node in known.items() if node.state != "ended" and name != STATUS_SOCKET)
    return {name: f"ipc://{folder}/{name}" for name in running}


def _all_ready(known: Mapping[str, Status]) -> bool:
    launch = known.get(STATUS_SOCKET)
    counted = launch is not None and len(known) > launch.counters["nodes"]
    return counted and all(status.state != "starting" for status in known.values())


class LaunchView:
    """Collects the statuses of a launch and makes rates of their totals."""

    def __init__(self) -> None:
        self._history: dict[str, list[Status]] = {}
        self._came_at = 0.0

    def add(self, status: Status) -> None:
        """Take a status; one of a process that was restarted begins a new history."""
        history = self._history.setdefault(status.node, [])
        if history and status.counters.get("pid") != history[-1].counters.get("pid"):
            history.clear()
        history.append(status)
        del history[:-_KEPT]
        self._came_at = time.monotonic()

    def listen(self, subscriber: NewestSubscriber, seconds: float) -> None:
        """Take in what comes within the time."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            message = subscriber.receive(left)
            if isinstance(message, Status):
                self.add(message)

    @classmethod
    def whole(cls, subscriber: NewestSubscriber) -> "LaunchView":
        """A view of all nodes, as soon as they have been seen for long enough to have rates. Raises TransportError: the
        launcher says nothing."""
        view, deadline = cls(), time.monotonic() + ANSWER_S
        while not view._complete:
            if time.monotonic() > deadline:
                where = ", ".join(subscriber.endpoints)
                raise TransportError(f"{where}: no launcher has reported its nodes for {ANSWER_S:g} s; does it run?")
            view.listen(subscriber, LISTEN_S)
        return view

    @property
    def _complete(self) -> bool:
        """Whether the launch and all of its nodes have been seen for long enough to have rates."""
        launch = self._history.get(STATUS_SOCKET, [])
        seen = bool(launch) and launch[-1].stamp_ns - launch[0].stamp_ns >= RATE_LEAST_S * 1e9
        return seen and len(self._history) - 1 == launch[-1].counters["nodes"]

    @property
    def silent_s(self) -> float:
        """Seconds since the launcher has said anything."""
        return time.monotonic() - self._came_at

    @property
    def ended(self) -> bool:
        """Whether the launch has said that it ends."""
        launch = self._history.get(STATUS_SOCKET, [])
        return bool(launch) and launch[-1].state == "ended"

    def to_json(self) -> dict[str, Any]:
        """``launch`` and ``nodes`` by name, each with state, figures of the process, rates, totals, ages, warnings."""
        rows = {name: _describe(history) for name, history in self._history.items()}
        return {"launch": rows.pop(STATUS_SOCKET, None), "nodes": dict(sorted(rows.items()))}

    def table(self) -> Table:
        """For people."""
        shown = self.to_json()
        rows = {**shown["nodes"], **({STATUS_SOCKET: shown["launch"]} if shown["launch"] else {})}
        cells = [(name, *(_cell(row, *column) for column in _COLUMNS.values())) for name, row in rows.items()]
        warnings = [f"{name}: {t}" for name, row in rows.items() for t in row["degraded"] if name != STATUS_SOCKET]
        return table(
            cells,
            ("node", *_COLUMNS),
            title=f"launch, last report {self.silent_s:.1f} s ago",
            caption="\n".join(map(visible, warnings)),
            numbers=[name for name in _COLUMNS if name != "state"],
        )


def _describe(history: list[Status]) -> dict[str, Any]:
    last = history[-1]
    since = next((s for s in history if last.stamp_ns - s.stamp_ns <= RATE_WINDOW_S * 1e9), last)
    seconds, said_s = (last.stamp_ns - since.stamp_ns) / 1e9, _said_s(last) - _said_s(since)
    gained = {name: last.counters[name] - since.counters.get(name, 0) for name in last.counters}
    rates = {name: gained[name] / said_s for name in _RATES if name in gained} if said_s > 0 else {}
    losses = [last.counters[name] for name in _LOSSES if name in last.counters]
    return {
        "state": last.state,
        "pid": last.counters.get("pid"),
        "restarts": last.counters.get("restarts", 0),
        "memory_mb": round(last.counters.get("rss_kb", 0) / 1024, 1),
        **({"log_mb": round(last.counters["log_kb"] / 1024, 1)} if "log_kb" in last.counters else {}),
        "lost": sum(losses) if losses else None,
        **({"cpu_percent": round(gained["cpu_ms"] / seconds / 10, 1)} if seconds and "cpu_ms" in gained else {}),
        **({"step_ms": round(gained["step_us"] / gained["fused"] / 1e3, 2)} if gained.get("fused") else {}),
        **({"changes": "{moved}/{new}/{gone}".format_map(last.counters)} if "moved" in last.counters else {}),
        "rates_hz": {name: round(rate, 2) for name, rate in rates.items()},
        "ages_s": {name: round(age, 3) for name, age in last.ages_s.items()},
        "counters": dict(last.counters),
        "degraded": list(last.degraded),
    }


def _said_s(status: Status) -> float:
    """When a node reported its own totals; the launcher passes them on later."""
    return status.stamp_ns / 1e9 - status.ages_s.get("status", 0.0)


def _cell(row: Mapping[str, Any], pattern: str, *names: str) -> str:
    """The first of the figures that a node has, by dotted name; empty where it has none."""
    values = (dig(row, name) for name in names)
    return next((pattern.format(value) for value in values if value is not None), "")


_RATES = ("published", "fused", "recorded", "messages")
# Mapper: frames that never came, or could not be used. Camera: images that became no frame, for want of a pose mostly.
# Recorder: frames that never came, and messages that the disk had no room for. All: messages that could not be read.
_LOSSES = ("missed", "refused", "missing", "lost", "rejected")
_COLUMNS = {  # by heading: how it is written, and what
    "state": ("{}", "state"),
    "pid": ("{}", "pid"),
    "up s": ("{:.1f}", "ages_s.start"),
    "restarts": ("{}", "restarts"),
    "MB": ("{:.0f}", "memory_mb"),
    "cpu %": ("{:.0f}", "cpu_percent"),
    "frames/s": ("{:.1f}", "rates_hz.published", "rates_hz.recorded"),
    "mapped/s": ("{:.1f}", "rates_hz.fused"),
    "step ms": ("{:.1f}", "step_ms"),
    "frame s": ("{:.1f}", "ages_s.frame"),
    "age s": ("{:.1f}", "ages_s.capture"),
    "msgs/s": ("{:.1f}", "rates_hz.messages"),
    "log MB": ("{:.1f}", "log_mb"),
    "lost": ("{}", "lost"),
    "moved/new/gone": ("{}", "changes"),
    "beat s": ("{:.1f}", "ages_s.beat"),
}
