"""What ``view --status`` shows of a running launch: rates from totals, one row a node."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from semantic_mapper.nodes.launcher.launch_file import STATUS_SOCKET
from semantic_mapper.plain_text import visible
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import NewestSubscriber

RATE_WINDOW_S = 5.0  # over which rates are taken, where so much has been seen
RATE_LEAST_S = 2.0  # nodes tell their totals once a second
_KEPT = 64  # statuses a node


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

    @property
    def complete(self) -> bool:
        """Whether the launch and all of its nodes have been seen for long enough to have rates."""
        launch = self._history.get(STATUS_SOCKET, [])
        seen = bool(launch) and launch[-1].stamp_ns - launch[0].stamp_ns >= RATE_LEAST_S * 1e9
        return seen and len(self._history) - 1 == launch[-1].counters["nodes"]

    @property
    def all_ready(self) -> bool:
        """Whether no node that has been seen is still starting."""
        return all(history[-1].state != "starting" for history in self._history.values())

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
        table = Table(
            title=f"launch, heard {self.silent_s:.1f} s ago",
            title_justify="left",
            box=SIMPLE,
            collapse_padding=True,
            pad_edge=False,
        )
        for heading in ("node", *_COLUMNS):
            table.add_column(heading, justify="left" if heading in ("node", "state") else "right", no_wrap=True)
        shown = self.to_json()
        rows = {**shown["nodes"], **({STATUS_SOCKET: shown["launch"]} if shown["launch"] else {})}
        for name, row in rows.items():
            table.add_row(name, *(show(row) for show in _COLUMNS.values()))
        warnings = [f"{name}: {t}" for name, row in rows.items() for t in row["degraded"] if name != STATUS_SOCKET]
        if warnings:
            table.caption, table.caption_justify = Text("\n".join(map(visible, warnings))), "left"
        return table


def _describe(history: list[Status]) -> dict[str, Any]:
    last = history[-1]
    since = next((s for s in history if last.stamp_ns - s.stamp_ns <= RATE_WINDOW_S * 1e9), last)
    seconds, said_s = (last.stamp_ns - since.stamp_ns) / 1e9, _said_s(last) - _said_s(since)
    gained = {name: last.counters[name] - since.counters.get(name, 0) for name in last.counters}
    rates = {name: gained[name] / said_s for name in _RATES if name in gained} if said_s > 0 else {}
    cpu = {"cpu_percent": round(gained["cpu_ms"] / seconds / 10, 1)} if seconds and "cpu_ms" in gained else {}
    step = {"step_ms": round(gained["step_us"] / gained["fused"] / 1e3, 2)} if gained.get("fused") else {}
    return {
        "state": last.state,
        "pid": last.counters.get("pid"),
        "restarts": last.counters.get("restarts", 0),
        "memory_mb": round(last.counters.get("rss_kb", 0) / 1024, 1),
        **({"log_mb": round(last.counters["log_kb"] / 1024, 1)} if "log_kb" in last.counters else {}),
        "lost": _lost(last.counters),
        **cpu,
        **step,
        "rates_hz": {name: round(rate, 2) for name, rate in rates.items()},
        "ages_s": {name: round(age, 3) for name, age in last.ages_s.items()},
        "counters": dict(last.counters),
        "degraded": list(last.degraded),
    }


def _said_s(status: Status) -> float:
    """When a node reported its own totals; the launcher passes them on later."""
    return status.stamp_ns / 1e9 - status.ages_s.get("status", 0.0)


def _rate(name: str) -> Any:
    return lambda row: f"{row['rates_hz'][name]:.1f}" if name in row["rates_hz"] else ""


def _figure(name: str, pattern: str = "{}") -> Any:
    return lambda row: pattern.format(row[name]) if row.get(name) is not None else ""


def _age(name: str) -> Any:
    return lambda row: f"{row['ages_s'][name]:.1f}" if name in row["ages_s"] else ""


def _lost(counters: Mapping[str, int]) -> int | None:
    """What a node lost, of what it should have passed on, mapped or recorded; None where it does not say."""
    known = [counters[name] for name in _LOSSES if name in counters]
    return sum(known) if known else None


def _frame_rate(row: Mapping[str, Any]) -> str:
    return _rate("published")(row) or _rate("recorded")(row)


_RATES = ("published", "fused", "recorded", "messages")
# Mapper: frames that never came, or could not be used. Camera: images that became no frame, for want of a pose mostly.
# Recorder: frames that never came, and messages that the disk had no room for. All: messages that could not be read.
_LOSSES = ("missed", "refused", "missing", "lost", "rejected")
_COLUMNS: dict[str, Any] = {
    "state": _figure("state"),
    "pid": _figure("pid"),
    "up s": _age("start"),
    "restarts": _figure("restarts"),
    "MB": _figure("memory_mb", "{:.0f}"),
    "cpu %": _figure("cpu_percent", "{:.0f}"),
    "frames/s": _frame_rate,
    "mapped/s": _rate("fused"),
    "step ms": _figure("step_ms", "{:.1f}"),
    "frame s": _age("frame"),
    "age s": _age("capture"),
    "msgs/s": _rate("messages"),
    "log MB": _figure("log_mb", "{:.1f}"),
    "lost": _figure("lost"),
    "beat s": _age("beat"),
}
