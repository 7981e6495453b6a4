"""Where there is no systemd, and the unit file; what systemd receives: tests/nodes/test_faults.py."""

import shutil
import subprocess
from pathlib import Path

import pytest
import structlog.testing

from semantic_mapper.nodes.launcher.launcher import Notifier
from tests.nodes.support import REPLAY_LAUNCH

UNIT = REPLAY_LAUNCH.parent / "systemd" / "semantic-mapper.service"


def test_without_systemd_nothing_is_sent_and_a_socket_that_is_gone_is_told_once(tmp_path: Path) -> None:
    Notifier.from_environment({}).ready("well")
    with structlog.testing.capture_logs() as logs:
        notifier = Notifier.from_environment({"NOTIFY_SOCKET": str(tmp_path / "gone")})
        notifier.ready("well")
        notifier.stopping(1.0)
        Notifier.from_environment({"NOTIFY_SOCKET": "tcp://somewhere"}).ready("well")
    assert [entry["event"] for entry in logs] == ["systemd_not_reached"] * 2


def test_unit_file_is_one_that_systemd_takes(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on this machine")
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text(encoding="utf-8"), encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(unit)],
        capture_output=True,
        text=True,
        check=False,
    )
    told = [line for line in (done.stdout + done.stderr).splitlines() if UNIT.name in line]
    assert (done.returncode, told) == (0, []), done.stderr
