"""As a library we leave stdout to the program, and its set-up of structlog as it is."""

import subprocess
import sys
from pathlib import Path

import pytest

import semantic_mapper

LOAD = """
import logging, structlog
from semantic_mapper.log_events import get_logger
log = get_logger("semantic_mapper.some.module")
"""
EVENTS = """
log.debug("quiet")
log.info("quiet", too=1)
log.warning("disk_full", free_mb=3, path="50 % of it")
try:
    1 / 0
except ZeroDivisionError:
    log.exception("broken")
log.bind(node="x").warning("bound")
"""


@pytest.mark.parametrize(
    ("setup", "stdout", "stderr", "never"),
    [
        ("", "", ["disk_full", "free_mb=3", "50 % of it", "ZeroDivisionError", "bound"], "quiet"),
        (
            "logging.basicConfig(level=logging.DEBUG, format='%(name)s %(levelname)s %(message)s')",
            "",
            ["semantic_mapper.some.module INFO quiet", "semantic_mapper.some.module WARNING disk_full"],
            "\0",
        ),
        (
            "structlog.configure(processors=[structlog.processors.JSONRenderer()])",
            '{"free_mb": 3, "path": "50 % of it", "event": "disk_full"}',
            [],
            "disk_full",
        ),
    ],
    ids=["nothing set up", "logging set up", "structlog set up"],
)
def test_events_go_where_the_program_says_and_else_warnings_to_stderr(
    setup: str, stdout: str, stderr: list[str], never: str
) -> None:
    code = f"{LOAD}{setup}\n{EVENTS}assert structlog.is_configured() == {setup.startswith('structlog')}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert stdout in done.stdout and bool(stdout) == bool(done.stdout)
    assert all(part in done.stderr for part in stderr) and never not in done.stderr


def test_no_library_module_logs_past_log_events() -> None:
    """structlog's own loggers print to stdout where the program has not configured it."""
    root = Path(semantic_mapper.__file__).parent
    files = [p for folder in (root, root / "drivers", root / "replay") for p in folder.rglob("*.py")]
    users = {p.relative_to(root).as_posix() for p in files if "structlog.get_logger(" in p.read_text(encoding="utf-8")}
    assert len(files) > 200 and {u for u in users if not u.startswith("nodes/")} == {"log_events.py"}
