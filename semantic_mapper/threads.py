"""One thread pool for torch and the compiled kernels, which share OpenMP's; and word of kernels being compiled."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import numba
import structlog
import torch
from numba.core import config as numba_config
from numba.core import event as numba_event

from semantic_mapper.kernel_cache import kernel

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

_log = structlog.get_logger(__name__)


class _CompileNotice(numba_event.Listener):
    """Tells once in the log why nothing seems to happen. Kernels that come from numba's cache are no such event."""

    def __init__(self) -> None:
        self._told = False

    def on_start(self, event: Any) -> None:
        if not self._told:
            self._told = True
            _log.info("compiling_kernels", note="once on this machine; all of them take about two minutes")

    def on_end(self, event: Any) -> None:
        pass


numba_event.register("numba:compile", _CompileNotice())


@functools.cache
def share_threads() -> int:
    """Start numba's threads and give torch its own number of threads back; returns what a kernel will use.

    Starting them sets OpenMP's thread count to numba's for the whole process. Torch, which still believes in its own
    (``OMP_NUM_THREADS``, say), then splits and rounds its convolutions differently, and oneDNN's backward pass, planned
    for one count and run with the other, can crash.
    """
    # Open3D brings a TBB older than numba accepts; numba, asking for it first, would warn before going on.
    priority: Any = numba_config
    priority.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]
    threads = torch.get_num_threads()
    follow_torch_threads()  # starts them
    torch.set_num_threads(threads)
    return numba.get_num_threads()


def follow_torch_threads() -> None:
    """Let the kernels that this thread starts use as many threads as torch does now."""
    started: Any = numba_config
    numba.set_num_threads(min(torch.get_num_threads(), started.NUMBA_NUM_THREADS))


def parallel_kernel(*, fastmath: bool = False) -> Callable[[FunctionT], FunctionT]:
    """A `kernel` with ``prange`` loops, on the shared threads."""
    share_threads()
    return kernel(parallel=True, fastmath=fastmath)


def inlined_kernel(function: FunctionT) -> FunctionT:
    """``numba.njit`` with fast mathematics for a part of a kernel, compiled into every kernel that calls it.

    Fast mathematics rounds otherwise where LLVM inlines a part than where it calls it, and which of both it did hung on
    what had been compiled before: a machine's first run differed from its second in the last digits.
    """
    decorate: Any = numba.njit(fastmath=True, nogil=True, forceinline=True)
    return decorate(function)
