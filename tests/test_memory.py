from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import resource
import torch
from semantic_mapper.memory import keep_freed_memory
if {keep}:
    print(keep_freed_memory())
def work():
    for _ in range(20):
        torch.ones(16 << 20)
work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(*, keep: bool) -> int:
    """Page faults of twenty tensors of 64 MB, one after the other."""
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(keep=keep)], capture_output=True, text=True, timeout=120, check=True
    )
    lines = done.stdout.split()
    if lines[0] == "False":
        pytest.skip("the C library of this machine is not glibc")
    return int(lines[-1])


def test_freed_memory_is_used_again() -> None:
    assert faults(keep=True) < 100 < faults(keep=False)
