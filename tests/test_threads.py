from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numba import prange

from semantic_mapper.threads import parallel_kernel, share_threads

COUNT = re.compile(r"omp_get_max_threads\(\) : (\d+)")
CODE = """
import numpy as np, torch
from tests.mapping.views import small_map, frame
small_map().integrate(frame(), np.ones((120, 160), np.float32), None, None)  # Open3D and several kernels
print(torch.__config__.parallel_info())
"""


@pytest.mark.parametrize("asked", [1, 2])
def test_kernels_leave_torch_the_threads_that_it_believes_in(asked: int) -> None:
    """OneDNN plans for one count and would run, and sometimes crash, with the other."""
    environment = os.environ | {"OMP_NUM_THREADS": str(asked)}
    done = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, timeout=200, env=environment, check=True
    )
    found = COUNT.search(done.stdout)
    assert found and int(found[1]) == asked, done.stdout


NOTICE = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from kernels import add
print("first", add(np.ones(3)))
print("second", add(np.ones(3, np.float32)))
"""
KERNELS = """
from numba import njit
import semantic_mapper.threads

@njit(cache=True)
def add(x):
    return x.sum()
"""


def test_it_is_told_once_that_kernels_are_compiled_and_not_where_they_are_cached(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS, encoding="utf-8")
    said: list[list[str]] = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", NOTICE, str(tmp_path)], capture_output=True, text=True, timeout=200, check=True
        )
        said.append([line for line in done.stdout.splitlines() if "compiling_kernels" in line or "first" in line])
    assert ["compiling_kernels" in line for line in said[0]] == [True, False], "once, and before the kernel runs"
    assert len(said[1]) == 1 and said[1][0].startswith("first")


def test_kernels_use_as_many_threads_as_torch_at_most() -> None:
    assert 1 <= share_threads() <= torch.get_num_threads()


@parallel_kernel()
def _double(x: np.ndarray) -> None:
    for i in prange(len(x)):
        x[i] *= 2


def test_a_parallel_kernel_runs() -> None:
    x = np.arange(1000.0)
    _double(x)
    assert (x == 2 * np.arange(1000.0)).all()
