"""Runs that fill a store, as their drivers report them."""

from __future__ import annotations

import time

import msgspec
from rich.box import SIMPLE
from rich.live import Live
from rich.table import Table

from semantic_mapper.log_events import get_logger
from semantic_mapper.nodes.console import Output
from semantic_mapper.nodes.fleet.runner import REPORT_S, DriverStatus
from semantic_mapper.nodes.fleet.store import Store

SILENT_S = 12 * REPORT_S  # after which a driver is taken for dead
SHOWN = 20
DEAD = "no report any more"

_log = get_logger(__name__)


def show_drivers(url: str, output: Output, *, once: bool, json: bool) -> None:
    """Show a table of the runs, again and again until none is going on.

    Raises:
        ConfigError, StoreError: no store, or it cannot be reached.
    """
    store = Store(url)
    unreadable: set[str] = set()
    statuses = read_drivers(store, unreadable)
    if json:
        output.json({"store": store.shown, "drivers": [_plain(status) for status in statuses]})
        return
    if once or not output.console.is_terminal or not any(_goes_on(s) for s in statuses):
        output.print(_table(store, statuses))
        return
    with Live(_table(store, statuses), console=output.console, auto_refresh=False) as live:
        while any(_goes_on(s) for s in statuses):
            time.sleep(REPORT_S / 2)
            statuses = read_drivers(store, unreadable)
            live.update(_table(store, statuses), refresh=True)


def read_drivers(store: Store, unreadable: set[str]) -> list[DriverStatus]:
    """The newest ``SHOWN`` runs, newest first.

    Args:
        store: Where they report.
        unreadable: Documents that were left out, because they are damaged or of another version. Each is warned of
            once and added.
    """
    names = sorted(store.names("drivers"), reverse=True)[:SHOWN]  # their names begin with the time
    found: list[DriverStatus] = []
    for name, data in store.read_many(f"drivers/{n}" for n in names):
        try:
            found.append(msgspec.json.decode(data, type=DriverStatus))
        except msgspec.DecodeError as error:
            if name not in unreadable:
                _log.warning("driver_status_skipped", file=f"{store.shown}/{name}", error=str(error))
                unreadable.add(name)
    return sorted(found, key=lambda status: status.started_ns, reverse=True)


def _goes_on(status: DriverStatus) -> bool:
    return _state(status) == ""


def _state(status: DriverStatus) -> str:
    silent_s = (time.time_ns() - status.updated_ns) / 1e9
    return status.ended or (DEAD if silent_s > SILENT_S else "")


def _plain(status: DriverStatus) -> dict[str, object]:
    return {**msgspec.to_builtins(status), "ended": _state(status)}


def _table(store: Store, statuses: list[DriverStatus]) -> Table:
    table = Table(title=store.shown, title_justify="left", box=SIMPLE, pad_edge=False)
    for name in ("run", "operation", "version", "host", "state"):
        table.add_column(name)
    for name in ("done", "were there", "failed", "running", "of", "logs/s", "left"):
        table.add_column(name, justify="right")
    for s in statuses:
        left = "-" if s.eta_s is None or _state(s) else _duration(s.eta_s)
        counts = (s.done, s.existing, s.failed, 0 if _state(s) else s.running, s.total)
        table.add_row(
            s.id,
            s.operation,
            s.version,
            f"{s.host}:{s.pid}",
            _state(s) or "runs",
            *map(str, counts),
            f"{s.rate:.2f}",
            left,
        )
    return table


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
