"""Notifications to systemd (sd_notify) over the datagram socket that it names; without one nothing is sent."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

import structlog

SYSTEMD_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")  # for the launcher alone, not for its nodes

_log = structlog.get_logger(__name__)


class Notifier:
    """Tells systemd how the service is. What cannot be told is logged, and nothing else changes.

    Args:
        address: Path of the socket, "@name" for an abstract one; empty = nobody listens.
        watchdog_s: How often systemd wants a sign of life, at least; 0 = never.
    """

    def __init__(self, address: str, watchdog_s: float = 0.0) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s = watchdog_s
        self._last_sign = 0.0
        self._last_status = ""
        self._failed = False

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None) -> Notifier:
        """As systemd has set it up; a watchdog that is meant for another process is none of ours."""
        given = os.environ if environment is None else environment
        address = given.get("NOTIFY_SOCKET", "")
        usec, pid = given.get("WATCHDOG_USEC", ""), given.get("WATCHDOG_PID", "")
        ours = usec.isdigit() and pid in ("", str(os.getpid()))
        if address and not address.startswith(("/", "@")):
            _log.warning("systemd_not_told", reason=f"NOTIFY_SOCKET={address}: neither a path nor an abstract socket")
            address = ""
        return cls(address, int(usec) / 1e6 if ours else 0.0)

    @property
    def wanted(self) -> bool:
        """Whether anybody listens."""
        return bool(self._address)

    def ready(self, status: str) -> None:
        """Start-up is over."""
        self._send("READY=1", f"STATUS={_one_line(status)}")

    def stopping(self, extend_s: float) -> None:
        """The end has begun, and may take so long."""
        self._send("STOPPING=1", f"EXTEND_TIMEOUT_USEC={round(extend_s * 1e6)}")

    def status(self, text: str) -> None:
        """One line for ``systemctl status``; sent when it changes."""
        if text != self._last_status:
            self._last_status = text
            self._send(f"STATUS={_one_line(text)}")

    def alive(self) -> None:
        """A sign of life, as often as the watchdog asks for; to be called in a loop."""
        now = time.monotonic()
        if self._watchdog_s and now - self._last_sign >= self._watchdog_s / 3:
            self._last_sign = now
            self._send("WATCHDOG=1")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)  # systemd that does not read must not hold the launch up
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:
            if not self._failed:
                _log.warning("systemd_not_told", what=lines[0], reason=str(error))
            self._failed = True


def _one_line(text: str) -> str:
    return " ".join(text.split("\n"))
