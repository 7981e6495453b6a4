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
    """Tells systemd the state of the service. What cannot be sent is logged once.

    Args:
        address: Path of the socket, "@name" for an abstract one; empty = none.
        watchdog_s: How often systemd wants a sign of life, at least; 0 = never.
    """

    def __init__(self, address: str, watchdog_s: float = 0.0) -> None:
        self._address = address.replace("@", "\0", 1) if address.startswith("@") else address
        self._watchdog_s = watchdog_s
        self._last_sign = 0.0
        self._last_status = ""
        self._extended_at = float("-inf")
        self._failed = False

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Notifier:
        """As systemd has set it up; a watchdog may be meant for another process."""
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        ours = usec.isdigit() and pid in ("", str(os.getpid()))
        return cls(environment.get("NOTIFY_SOCKET", ""), int(usec) / 1e6 if ours else 0.0)

    def ready(self, status: str) -> None:
        """Start-up is over."""
        self._send(f"READY=1\nSTATUS={_one_line(status)}")

    def stopping(self, extend_s: float) -> None:
        """The end has begun, and may take so long from now; to be called in a loop."""
        if time.monotonic() - self._extended_at < min(1.0, extend_s / 3):
            return
        self._extended_at = time.monotonic()
        self._send(f"STOPPING=1\nEXTEND_TIMEOUT_USEC={round(extend_s * 1e6)}")

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

    def _send(self, message: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
                sender.sendto(message.encode(), self._address)
        except OSError as error:
            if not self._failed:
                _log.warning("systemd_not_reached", what=message.split("\n")[0], reason=str(error))
            self._failed = True


def _one_line(text: str) -> str:
    return " ".join(text.split("\n"))
