"""The viewer's servers are waited for as long as they get on; a program of the test stands in for Rerun's."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from semantic_mapper.errors import TransportError
from semantic_mapper.nodes.launcher.liveness import ProgressLimit
from semantic_mapper.nodes.viewer import server

PROGRAM = """#!{python} -I
import socket, sys, time
if sys.argv[1] == "analytics":
    sys.exit(0)
while time.process_time() < 1.5:  # as an overloaded machine has to load it
    pass
if {stuck}:
    print("the door is locked", flush=True)
    time.sleep(1000)
ports = [sys.argv[sys.argv.index(name) + 1] for name in ("--port", "--web-viewer-port")]
sockets = [socket.create_server(("127.0.0.1", int(port))) for port in ports]
time.sleep(1000)
"""


def program(path: Path, *, stuck: bool) -> str:
    path.write_text(PROGRAM.format(python=sys.executable, stuck=stuck))
    path.chmod(0o755)
    return str(path)


def test_a_viewer_that_is_stuck_is_given_up_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = itertools.count()
    monkeypatch.setattr(server, "_find_program", lambda: program(tmp_path / "rerun", stuck=True))

    def at_once(limit_s: float, cpu_s: Callable[[], float]) -> ProgressLimit:
        return ProgressLimit(limit_s, lambda: min(cpu_s(), 1.5), lambda: float(next(ticks)) / 5)

    monkeypatch.setattr(server, "ProgressLimit", at_once)
    with pytest.raises(TransportError, match=r"has not started.* the door is locked"), server.WebViewer(0, 0):
        pass
