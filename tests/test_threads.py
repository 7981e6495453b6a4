from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from semantic_mapper.threads import parallel_kernel

COUNT = re.compile(r"omp_get_max_threads\(\) : (\d+)")
CODE = """
import sys
import numpy as np, torch
from tests.mapping.views import small_map, frame
small_map().integrate(frame(), np.ones((120, 160), np.float32), None, None)  # Open3D and several kernels
print(torch.__config__.parallel_info())
print("numba threads:", "numba.np.ufunc.omppool" in sys.modules or "numba.np.ufunc.workqueue" in sys.modules)
"""


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [1, 2])
def test_kernels_neither_change_torchs_thread_count_nor_start_numbas_threads(wanted: int) -> None:
    """OneDNN plans for one count and would run, and sometimes crash, with another."""
    environment = os.environ | {"OMP_NUM_THREADS": str(wanted)}
    done = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, timeout=200, env=environment, check=True
    )
    found = COUNT.search(done.stdout)
    assert found and int(found[1]) == wanted, done.stdout
    assert "numba threads: False" in done.stdout


NOTICE = """
import logging, sys
logging.basicConfig(level=logging.INFO)
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


@pytest.mark.slow
def test_compiling_is_logged_once_and_not_where_kernels_are_cached(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS, encoding="utf-8")
    said: list[list[str]] = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", NOTICE, str(tmp_path)], capture_output=True, text=True, timeout=200, check=True
        )
        lines = (done.stdout + done.stderr).splitlines()
        said.append([line for line in lines if "compiling_kernels" in line])
    assert [len(lines) for lines in said] == [1, 0]


@parallel_kernel()
def _count_visits(start: int, stop: int, visits: np.ndarray) -> None:
    for i in range(start, stop):
        visits[i] += 1


@parallel_kernel(chunks_per_thread=4)
def _divide(start: int, stop: int, x: np.ndarray, by: np.ndarray) -> None:
    for i in range(start, stop):
        x[i] = x[i] // by[i]


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 1000])
def test_every_iteration_runs_once(threads: int, count: int) -> None:
    visits = np.zeros(count + 1, np.int64)
    _count_visits(count, visits)
    assert (visits[:count] == 1).all() and visits[count] == 0


def test_an_error_in_any_part_reaches_the_caller_and_the_kernel_runs_again(threads: int) -> None:
    for wrong in (0, 999):
        by = np.ones(1000, np.int64)
        by[wrong] = 0
        with pytest.raises(ZeroDivisionError):
            _divide(1000, np.ones(1000, np.int64), by)
    x = np.full(1000, 6)
    _divide(1000, x, np.full(1000, 3))
    assert (x == 2).all()


def test_kernels_run_from_many_threads_at_once(threads: int) -> None:
    barrier = threading.Barrier(8)

    def run(n: int) -> np.ndarray:
        x = np.full(500, n)
        barrier.wait()
        for _ in range(50):
            _divide(500, x, np.ones(500, np.int64))
            _count_visits(500, x)
        return x

    with ThreadPoolExecutor(8) as pool:
        for n, x in enumerate(pool.map(run, range(8))):
            assert (x == n + 50).all()


def test_kernels_run_in_a_forked_child(threads: int) -> None:
    _count_visits(100, np.zeros(100, np.int64))  # the parent's threads are there
    child = os.fork()
    if child == 0:
        visits = np.zeros(100, np.int64)
        _count_visits(100, visits)
        os._exit(0 if (visits == 1).all() else 1)
    assert os.waitpid(child, 0)[1] == 0


AT_EXIT = """
import sys, threading, time
import numpy as np, torch
from semantic_mapper.threads import parallel_kernel

@parallel_kernel()
def add(start, stop, x):
    for i in range(start, stop):
        x[i] += 1

def go_on():
    threading.main_thread().join()
    x = np.zeros(10)
    add(10, x)
    print(x.sum())

torch.set_num_threads(2)
add(10, np.zeros(10))
threading.Thread(target=go_on).start()
"""


def test_a_thread_that_outlives_the_main_thread_still_runs_kernels(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(AT_EXIT, encoding="utf-8")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=200, check=True)
    assert done.stdout.split()[-1:] == ["10.0"] and "Error" not in done.stderr


@pytest.mark.parametrize(("given", "policy"), [({}, "passive"), ({"OMP_WAIT_POLICY": "active"}, "active")])
def test_importing_the_package_keeps_torchs_threads_from_spinning(given: dict[str, str], policy: str) -> None:
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")}
    code = "import os, semantic_mapper; print(os.environ['OMP_WAIT_POLICY'])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=200, env=inherited | given, check=True
    )
    assert done.stdout.strip() == policy


SPIN = """
import statistics, sys, time
import torch

def idle_cpu_s():
    x, costs = torch.ones(1 << 20), []
    for _ in range(21):
        x.add_(1)
        began = time.process_time()
        time.sleep(0.02)
        costs.append(time.process_time() - began)
    return statistics.median(costs)

before = idle_cpu_s()
sys.path.insert(0, sys.argv[1])
import kernels
kernels.run()
print(before, idle_cpu_s())
"""
SPIN_KERNELS = """
import numpy as np
from semantic_mapper.threads import parallel_kernel

@parallel_kernel()
def add(start, stop, x):
    for i in range(start, stop):
        x[i] += 1

def run():
    add(10, np.zeros(10))
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="on one core OpenMP's threads do not spin")
def test_torchs_threads_stop_spinning_where_torch_was_imported_first(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(SPIN_KERNELS, encoding="utf-8")
    cores = len(os.sched_getaffinity(0))
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")} | {"OMP_NUM_THREADS": str(cores)}
    done = subprocess.run(
        [sys.executable, "-c", SPIN, str(tmp_path)], capture_output=True, text=True, timeout=200, env=inherited
    )
    before, after = map(float, done.stdout.split()[-2:])
    assert after < before / 2, f"CPU time while idle after an operation: {before} s before, {after} s after"
