"""As a library we leave stdout to the program, and its set-up of structlog as it is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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


def run(code: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done


def test_where_nothing_is_set_up_warnings_go_to_stderr_and_nothing_to_stdout() -> None:
    done = run(LOAD + EVENTS + "assert not structlog.is_configured()")
    assert done.stdout == ""
    assert "disk_full" in done.stderr and "free_mb=3" in done.stderr and "50 % of it" in done.stderr
    assert "ZeroDivisionError" in done.stderr and "bound" in done.stderr and "quiet" not in done.stderr


def test_logging_that_is_set_up_gets_all_levels_by_module() -> None:
    setup = "logging.basicConfig(level=logging.DEBUG, format='%(name)s %(levelname)s %(message)s')\n"
    done = run(LOAD + setup + EVENTS)
    assert done.stdout == ""
    assert "semantic_mapper.some.module INFO quiet" in done.stderr
    assert "semantic_mapper.some.module WARNING disk_full" in done.stderr


def test_structlog_that_the_program_sets_up_later_is_used_as_it_is() -> None:
    setup = "structlog.configure(processors=[structlog.processors.JSONRenderer()])\n"
    done = run(LOAD + setup + EVENTS)
    assert '{"free_mb": 3, "path": "50 % of it", "event": "disk_full"}' in done.stdout and done.stderr == ""


def test_no_library_module_logs_past_log_events() -> None:
    """structlog's own loggers print to stdout where the program has not configured it."""
    root = Path(semantic_mapper.__file__).parent
    files = [p for folder in (root, root / "drivers", root / "replay") for p in folder.rglob("*.py")]
    users = {p.relative_to(root).as_posix() for p in files if "structlog.get_logger(" in p.read_text(encoding="utf-8")}
    assert len(files) > 200 and {u for u in users if not u.startswith("nodes/")} == {"log_events.py"}
