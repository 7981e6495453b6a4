import subprocess
from pathlib import Path

import pytest

from semantic_mapper.memory import is_out_of_memory
from tests.nodes.support import COMMAND, error_line


@pytest.mark.parametrize(
    ("error", "is_shortage"),
    [
        (MemoryError(), True),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"), True),
        (OSError(12, "Cannot allocate memory"), True),
        (RuntimeError("Exception from plugin.cpp:54:\nResource temporarily unavailable"), True),
        (BlockingIOError(11, "Resource temporarily unavailable"), False),
        (ImportError("libgomp.so.1: cannot allocate memory in static TLS block"), False),
        (ImportError("No module named 'torch'"), False),
    ],
)
def test_a_lack_of_memory_is_known_by_its_words(error: BaseException, is_shortage: bool) -> None:
    assert is_out_of_memory(error) == is_shortage


def test_a_verb_that_may_not_use_enough_memory_says_so(tmp_path: Path) -> None:
    limited = f"ulimit -v 900000; exec '{COMMAND}' demo --out '{tmp_path}'"
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1
    line = error_line(done.stderr)
    assert "not enough memory or address space" in line and "ulimit -v" in line and "make setup" not in line
