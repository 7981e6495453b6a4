"""Kernels on several threads: each iteration runs once, from any caller, and torch's threads leave them the cores."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Int64


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@parallel_kernel()
def count_visits(count: int, visits: Int64) -> None: ...


@parallel_kernel(chunks_per_thread=4)
def _count_visits(count: int, visits: Int64) -> None: ...


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 1000])
def test_every_iteration_runs_once(threads: int, count: int) -> None:
    for run in (count_visits, _count_visits):
        visits = np.zeros(count + 1, np.int64)
        run(count, visits)
        assert (visits[:count] == 1).all() and visits[count] == 0


def test_kernels_run_from_many_threads_at_once(threads: int) -> None:
    barrier = threading.Barrier(8)

    def run(n: int) -> np.ndarray:
        visits = np.full(500, n)
        barrier.wait()
        for _ in range(50):
            count_visits(500, visits)
            _count_visits(500, visits)
        return visits

    with ThreadPoolExecutor(8) as pool:
        for n, visits in enumerate(pool.map(run, range(8))):
            assert (visits == n + 100).all()


def test_kernels_run_in_a_forked_child(threads: int) -> None:
    count_visits(100, np.zeros(100, np.int64))  # the parent's threads are there
    child = os.fork()
    if child == 0:
        visits = np.zeros(100, np.int64)
        count_visits(100, visits)
        os._exit(0 if (visits == 1).all() else 1)
    assert os.waitpid(child, 0)[1] == 0


KERNELS = """
import numpy as np
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Int64

@parallel_kernel()
def count_visits(count: int, visits: Int64) -> None: ...

def run():
    visits = np.zeros(10, np.int64)
    count_visits(10, visits)
    return visits.sum()
"""


def output(folder: Path, code: str, **environment: str) -> list[str]:
    """What a script next to a module that holds ``run`` prints."""
    (folder / "kernels.py").write_text(KERNELS, encoding="utf-8")
    (folder / "script.py").write_text(code, encoding="utf-8")
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")}
    command = [sys.executable, str(folder / "script.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, env=inherited | environment)
    assert done.returncode == 0 and "Error" not in done.stderr, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize(("wanted", "threads"), [("1", 1), ("3", 3), ("4,2", 4), ("", None), ("none", None)])
def test_kernels_without_torch_use_the_threads_that_it_would_and_do_not_load_it(
    tmp_path: Path, wanted: str, threads: int | None
) -> None:
    code = "import sys, kernels; from semantic_mapper.kernels import binding as t; kernels.run()\n"
    code += "print(t.thread_count(), 'torch' in sys.modules)"
    expected = len(os.sched_getaffinity(0)) if threads is None else threads
    assert output(tmp_path, code, OMP_NUM_THREADS=wanted) == [str(expected), "False"]


SPIN = """
import statistics, time
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
import kernels
kernels.run()
print(before, idle_cpu_s())
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="on one core OpenMP's threads do not spin")
def test_torchs_threads_stop_spinning_where_torch_was_imported_first(tmp_path: Path) -> None:
    cores = len(os.sched_getaffinity(0))
    before, after = map(float, output(tmp_path, SPIN, OMP_NUM_THREADS=str(cores)))
    if before < 2e-4:
        pytest.skip("torch's threads do not spin here, whatever the package does")
    assert after < before / 2, f"CPU time while idle after an operation: {before} s before, {after} s after"
