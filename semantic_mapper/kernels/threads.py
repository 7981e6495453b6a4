"""Kernels whose loop is split over threads, as many as torch uses, or would use: kernels do not load it."""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Concatenate, Generic, ParamSpec

import semantic_mapper
from semantic_mapper.kernels.binding import Kernel

P = ParamSpec("P")

MAX_POOL_THREADS = 64  # enough for every caller to have its own; threads start only when they are needed


class ParallelKernel(Generic[P]):
    """A kernel that is split over threads; see `parallel_kernel`. Any number of threads may call it at once."""

    def __init__(self, kernel: Kernel[Concatenate[int, P], None], chunks_per_thread: int) -> None:
        functools.update_wrapper(self, kernel)
        self._kernel = kernel
        self._chunks_per_thread = chunks_per_thread

    def __call__(self, count: int, /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run iterations 0 to ``count`` on as many threads as torch uses, this one included; returns when all ended."""
        packed = self._kernel.pack(*args, **kwargs)
        threads = min(_thread_count(), count)
        if threads <= 1:
            self._run(0, count, packed)
            return
        _stop_spinning()
        chunks = min(threads * self._chunks_per_thread, count)
        ranges = iter([(count * n // chunks, count * (n + 1) // chunks) for n in range(chunks)])

        def work() -> None:
            for start, stop in ranges:
                self._run(start, stop, packed)

        others = [_submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            wait(others)  # they write into the caller's arrays
        for other in others:
            other.result()

    def _run(self, start: int, stop: int, packed: bytes) -> None:
        if self._kernel.function(start, stop, packed):
            raise MemoryError(f"kernel {self._kernel.name}: no memory for its buffers")


def parallel_kernel(
    chunks_per_thread: int = 1,
) -> Callable[[Callable[Concatenate[int, P], None]], ParallelKernel[P]]:
    """A `kernel` whose loop runs on several threads.

    The declaration's first argument is the number of iterations; C gets the range of a part of them as ``start`` and
    ``stop``, and returns 0, or 1 where it lacks memory for its buffers, which raises MemoryError. Iterations must not
    depend on each other: the result is then the same to the bit for any number of threads.

    Args:
        chunks_per_thread: More than 1 where iterations differ in cost. A chunk costs some 20 microseconds.
    """

    def decorate(declaration: Callable[Concatenate[int, P], None]) -> ParallelKernel[P]:
        return ParallelKernel(Kernel(declaration, skip=1), chunks_per_thread)

    return decorate


def _thread_count() -> int:
    # None where torch is not loaded; without the function while another thread is just loading it.
    return getattr(sys.modules.get("torch"), "get_num_threads", _count_of_environment)()


def _count_of_environment() -> int:
    count = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(count) if count.isdecimal() and int(count) > 0 else len(os.sched_getaffinity(0))


@functools.cache
def _stop_spinning() -> None:
    """Make torch's OpenMP threads sleep between operations where torch was loaded before this package.

    By default GNU OpenMP lets its threads spin for about 3 ms after each operation; a step of the mapper then takes 15
    times as long. It lets them spin for next to nothing once it manages more threads than there are cores. One more
    team of threads, which belongs to a thread that sleeps for good, sees to that.
    """
    if not semantic_mapper.SPINNING_THREADS:
        return
    import torch  # is loaded

    started = threading.Event()

    def start_team() -> None:
        torch.ones(1 << 20).add_(1)  # large enough for torch to use all its threads
        started.set()
        threading.Event().wait()

    threading.Thread(target=start_team, name="idle OpenMP team", daemon=True).start()
    started.wait()


def _submit(work: Callable[[], None]) -> Future[None]:
    try:
        return _pool.submit(work)
    except RuntimeError:  # the interpreter is ending and starts no threads; a thread that still maps does all by itself
        done: Future[None] = Future()
        done.set_result(None)
        return done


def _new_pool() -> None:
    global _pool
    _pool = ThreadPoolExecutor(MAX_POOL_THREADS, thread_name_prefix="kernel")


_new_pool()
os.register_at_fork(after_in_child=_new_pool)  # a child has none of its parent's threads
