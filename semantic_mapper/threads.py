"""Compiled loops on several threads, as many as torch uses; and a log event while kernels are compiled."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numba
import torch
from numba.core import event as numba_event

import semantic_mapper
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.log_events import get_logger

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
P = ParamSpec("P")

MAX_POOL_THREADS = 64  # enough for every caller to have its own; threads start only when they are needed

_log = get_logger(__name__)


class _CompileNotice(numba_event.Listener):
    """Logs once why nothing seems to happen. Kernels that come from numba's cache are no such event."""

    def __init__(self) -> None:
        self._logged = False

    def on_start(self, event: Any) -> None:
        if not self._logged:
            self._logged = True
            _log.info("compiling_kernels", note="once on this machine; all of them take about two minutes")

    def on_end(self, event: Any) -> None:
        pass


numba_event.register("numba:compile", _CompileNotice())


class ParallelKernel(Generic[P]):
    """A compiled loop that is split over threads; see `parallel_kernel`. Any number of threads may call it at once.

    It does not use numba's own threads. Their OpenMP layer needs a library that a bare system lacks, changes torch's
    thread count, and the layer without that need ends the process when two threads call kernels at once.
    """

    def __init__(self, run: Callable[Concatenate[int, int, P], None], chunks_per_thread: int) -> None:
        self._run = run
        self._chunks_per_thread = chunks_per_thread

    def __call__(self, count: int, /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run iterations 0 to ``count`` on as many threads as torch uses, this one included; returns when all ended."""
        threads = min(torch.get_num_threads(), count)
        if threads <= 1:
            self._run(0, count, *args, **kwargs)
            return
        _stop_spinning()
        chunks = min(threads * self._chunks_per_thread, count)
        ranges = iter([(count * n // chunks, count * (n + 1) // chunks) for n in range(chunks)])

        def work() -> None:
            for start, stop in ranges:
                self._run(start, stop, *args, **kwargs)

        others = [_submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            wait(others)  # they write into the caller's arrays
        for other in others:
            other.result()


def parallel_kernel(
    *, fastmath: bool = False, chunks_per_thread: int = 1
) -> Callable[[Callable[Concatenate[int, int, P], None]], ParallelKernel[P]]:
    """A `kernel` whose loop runs on several threads.

    The function takes the range of its loop as its first two arguments, ``start`` and ``stop``, writes each iteration's
    result into arrays and returns nothing. It is called with the number of iterations in their place. Iterations must
    not depend on each other; the result is then the same to the bit for any number of threads.

    Args:
        fastmath: As of `kernel`.
        chunks_per_thread: More than 1 where iterations differ in cost. A chunk costs some 20 microseconds.
    """

    def decorate(function: Callable[Concatenate[int, int, P], None]) -> ParallelKernel[P]:
        return ParallelKernel(kernel(fastmath=fastmath)(function), chunks_per_thread)

    return decorate


def inlined_kernel(function: FunctionT) -> FunctionT:
    """``numba.njit`` with fast mathematics for a part of a kernel, compiled into every kernel that calls it.

    Fast mathematics rounds otherwise where LLVM inlines a part than where it calls it, and which of both it did hung on
    what had been compiled before: a machine's first run differed from its second in the last digits.
    """
    decorate: Any = numba.njit(fastmath=True, nogil=True, forceinline=True)
    return decorate(function)


@functools.cache
def _stop_spinning() -> None:
    """Make torch's OpenMP threads sleep between operations where torch was loaded before this package.

    By default GNU OpenMP lets its threads spin for about 3 ms after each operation; a step of the mapper then takes 15
    times as long. It lets them spin for next to nothing once it manages more threads than there are cores. One more
    team of threads, which belongs to a thread that sleeps for good, sees to that.
    """
    if not semantic_mapper.SPINNING_THREADS:
        return
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
