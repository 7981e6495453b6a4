"""Process entry: thread counts, stop requests, stdout that holds results only."""

import json
import os
import signal
import subprocess
import sys

import pytest

from semantic_mapper.nodes.process import STOP_SIGNAL, StopRequest


def _python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")}
    return subprocess.run(
        [sys.executable, "-I", "-c", code], capture_output=True, text=True, check=False, env=inherited | environment
    )


def test_first_signal_is_noted_the_second_interrupts_and_handlers_are_given_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        assert not stop
        os.kill(os.getpid(), signal.SIGINT)
        assert stop and stop.name == "SIGINT" and stop.exit_code == 130
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before
    for first, name, code in ((signal.SIGTERM, "SIGTERM", 143), (STOP_SIGNAL, "the launcher", 0)):
        with StopRequest(patient=True, signals=(STOP_SIGNAL, signal.SIGTERM, signal.SIGINT)) as stop:
            for signum in (first, signal.SIGINT, signal.SIGTERM):
                os.kill(os.getpid(), signum)
            assert (stop.name, stop.exit_code) == (name, code), "a patient one keeps the first"


def test_threads_are_set_before_anything_heavy_is_loaded_and_the_users_choice_is_kept() -> None:
    code = """
import json, os, sys
from semantic_mapper.nodes.process import prepare_process
prepare_process()
print(json.dumps([os.environ["OMP_NUM_THREADS"], "torch" in sys.modules]))
"""
    omp, heavy = json.loads(_python(code).stdout)
    assert int(omp) >= 1 and not heavy
    assert json.loads(_python(code, OMP_NUM_THREADS="3").stdout)[0] == "3"


def test_stray_prints_never_reach_stdout() -> None:
    code = """
import atexit, ctypes, os
from semantic_mapper.nodes.console import Output
output = Output.guarded()
print("python print")
os.write(1, b"raw write\\n")
ctypes.CDLL(None).puts(b"c print")
atexit.register(os.write, 1, b"at exit\\n")
output.quiet = True
output.json({"a": 1})
"""
    done = _python(code)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"a": 1}
    for text in ("python print", "raw write", "c print", "at exit"):
        assert text in done.stderr


def test_an_event_is_one_line_and_survives_a_closed_stderr() -> None:
    code = """
import os, structlog
from semantic_mapper.nodes.process import prepare_process
prepare_process()
structlog.get_logger("x").error("broken", reason="first\\nsecond")
read, write = os.pipe()
os.dup2(write, 2); os.close(write); os.close(read)
structlog.get_logger("x").error("nobody hears this")
os.write(1, b"alive")
os._exit(0)
"""
    done = _python(code)
    assert done.stdout == "alive" and done.returncode == 0
    assert done.stderr.count("\n") == 1 and "first | second" in done.stderr


def test_no_event_but_a_warning_breaks_a_bar_on_a_terminal() -> None:
    code = """
import structlog
from semantic_mapper.nodes import console, process
process.prepare_process()
with console.frame_progress("map", 2):
    structlog.get_logger("x").info("map_saved"), structlog.get_logger("x").warning("left_out")
structlog.get_logger("x").info("after")
"""
    shown = _python(code, FORCE_COLOR="1").stderr
    assert "map_saved" not in shown and "left_out" in shown and "after" in shown and "left" in shown
