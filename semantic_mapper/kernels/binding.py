"""Calls the C kernels of ``src/``: one Python declaration a kernel says its arguments, and is what callers call.

Loops of parallel kernels are split over as many threads as torch uses, or would use: kernels do not load it.
"""

import ctypes
import functools
import inspect
import os
import platform
import struct
import sys
import threading
import typing
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import semantic_mapper
from semantic_mapper.errors import DependencyError, ShapeError
from semantic_mapper.kernels.digest import source_digest

P = ParamSpec("P")
R = TypeVar("R")

LIBRARY_FOLDER = Path(__file__).resolve().parent / "lib"
MAX_DIMENSIONS = 4
MAX_POOL_THREADS = 64  # enough for every caller to have its own; threads start only when they are needed
_NO_SHAPE = (1,) * MAX_DIMENSIONS
_Words = list[Any]
_Pack = Callable[[Any, _Words], None]


class Kernel(Generic[P, R]):
    """A function of the compiled library; see `kernel`. Any number of threads may call it at once, without the GIL."""

    def __init__(self, declaration: Callable[P, R], skip: int = 0, folder: Path = LIBRARY_FOLDER) -> None:
        functools.update_wrapper(self, declaration)
        self._folder = folder
        self.name = declaration.__name__.lstrip("_")
        self._declaration = declaration
        self._skip = skip

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run it once, over no range."""
        result = self.function(0, 0, self.pack(*args, **kwargs))
        return None if self._hints["return"] is type(None) else result  # pyright: ignore[reportReturnType]

    @functools.cached_property
    def function(self) -> Callable[[int, int, bytes], int]:
        """The C function: start and stop of its loop, and the packed arguments."""
        library, size = load_library(self._folder), -1
        function = getattr(library, self.name, None)
        if function is not None:
            function.argtypes, function.restype = (ctypes.c_int64, ctypes.c_int64, ctypes.c_char_p), ctypes.c_int64
            size = ctypes.c_int64.in_dll(library, f"{self.name}_size").value
        if function is None or size != self._struct.size:
            raise DependencyError(
                f"the compiled kernels have no kernel {self.name} that takes {self._struct.size} bytes of arguments: "
                "the library is of another version: run `make setup`, or install the package again"
            )
        return function

    def pack(self, *args: Any, **kwargs: Any) -> bytes:
        """Arguments as C takes them; the arrays must live until the kernel has ended.
        Raises ShapeError: an array has another dtype, more than 4 dimensions, or is not contiguous."""
        if kwargs:
            args = self._signature.bind(*(None,) * self._skip, *args, **kwargs).args[self._skip :]
        words: _Words = []
        for (name, (_, add)), value in zip(self._parameters.items(), args, strict=True):
            try:
                add(value, words)
            except ShapeError as error:
                raise ShapeError(f"kernel {self.name}, argument {name}: {error}") from None
        return self._struct.pack(*words)

    @functools.cached_property
    def _signature(self) -> inspect.Signature:
        return inspect.signature(self._declaration)

    @functools.cached_property
    def _hints(self) -> dict[str, Any]:
        return typing.get_type_hints(self._declaration)

    @functools.cached_property
    def _parameters(self) -> dict[str, tuple[str, _Pack]]:
        return {name: _packer(self._hints[name]) for name in list(self._signature.parameters)[self._skip :]}

    @functools.cached_property
    def _struct(self) -> struct.Struct:
        return struct.Struct("@" + "".join(code for code, _ in self._parameters.values()))


def kernel(declaration: Callable[P, R]) -> Kernel[P, R]:
    """Bind a declaration without a body to the C function of its name (a leading underscore aside).

    Its annotations say how each argument is passed: ``NDArray`` of one dtype as the array struct of that type in C,
    ``NDArray[Any]`` as an ``AnyArray``, ``int``, ``bool`` and ``float`` as numbers of 8 bytes, a named tuple as a
    struct of its fields. It returns None or an int."""
    return Kernel(declaration)


@functools.cache
def load_library(folder: Path = LIBRARY_FOLDER) -> ctypes.CDLL:
    """The kernels of a folder, compiled for the best of the processors that they are there for and this one is.
    Raises DependencyError: they are not there, or not for this machine."""
    machine = platform.machine()
    names = ["kernels-x86_64-avx2"] if machine == "x86_64" and has_avx2() else []
    for path in (folder / f"{name}.so" for name in (*names, f"kernels-{machine}")):
        if path.exists():
            try:
                library = ctypes.CDLL(str(path))
            except OSError as error:
                raise DependencyError(f"cannot load the compiled kernels {path}: {error}") from error
            _check_sources(library, folder.parent / "src")
            return library
    raise DependencyError(
        f"no compiled kernels for {machine} in {folder}; in a checkout run `make setup`, otherwise install the package "
        "with pip, which compiles them"
    )


def _check_sources(library: ctypes.CDLL, sources: Path) -> None:
    """Refuse a library whose sources have changed, as a checkout's do by `git pull`: it would answer wrong."""
    if sources.is_dir() and hasattr(library, "source_digest"):
        digest = source_digest(sources)
        if (ctypes.c_char * len(digest)).in_dll(library, "source_digest").value.decode() != digest:
            raise DependencyError(f"the kernels were compiled from other sources than {sources}: run `make setup`")


def has_avx2() -> bool:
    """Whether this x86-64 processor has AVX2 and FMA, as torch sees it: ATEN_CPU_CAPABILITY holds for both."""
    wanted = os.environ.get("ATEN_CPU_CAPABILITY")
    if wanted in ("default", "avx2", "avx512"):
        return wanted != "default"
    return {"avx2", "fma"} <= processor_flags()


def processor_flags() -> set[str]:
    """What Linux says that this x86-64 processor can do; empty elsewhere."""
    try:
        with Path("/proc/cpuinfo").open(encoding="ascii", errors="replace") as lines:
            return set(next((line.split() for line in lines if line.startswith("flags")), []))
    except FileNotFoundError:
        return set()


def _packer(hint: Any) -> tuple[str, _Pack]:
    """Format of one argument and how to add its words."""
    if hint in (int, float):
        return "q" if hint is int else "d", lambda value, words: words.append(value)
    if hint is bool:
        return "q", lambda value, words: words.append(int(value))  # numpy's bool is no integer
    parts = typing.get_args(hint)
    if typing.get_origin(hint) is np.ndarray:  # what NDArray[scalar] stands for, before numpy 2.5
        parts = typing.get_args(parts[1])
    if typing.get_origin(hint) in (np.ndarray, NDArray):
        scalar = None if parts[0] is Any else np.dtype(parts[0])
        return "Pq" + MAX_DIMENSIONS * "q", functools.partial(_add_array, scalar)
    if isinstance(hint, type) and issubclass(hint, tuple):
        fields = [_packer(field) for field in typing.get_type_hints(hint).values()]
        adders = [add for _, add in fields]

        def add_fields(value: Any, words: _Words) -> None:
            for add, field in zip(adders, value, strict=True):
                add(field, words)

        return "".join(code for code, _ in fields), add_fields
    raise TypeError(f"a kernel cannot take a {hint}")


def _add_array(dtype: np.dtype[Any] | None, value: Any, words: _Words) -> None:
    if not isinstance(value, np.ndarray) or (dtype is not None and value.dtype != dtype):
        raise ShapeError(f"expected an array of {dtype}, got {getattr(value, 'dtype', type(value))}")
    if not value.flags.c_contiguous or value.ndim > MAX_DIMENSIONS:
        raise ShapeError(f"expected a contiguous array of at most {MAX_DIMENSIONS} dimensions, got shape {value.shape}")
    words.append(value.__array_interface__["data"][0])
    words.append(value.itemsize)
    words.extend(value.shape + _NO_SHAPE[value.ndim :])


class ParallelKernel(Generic[P]):
    """A kernel that is split over threads; see `parallel_kernel`. Any number of threads may call it at once."""

    def __init__(self, kernel: Kernel[Concatenate[int, P], None], chunks_per_thread: int) -> None:
        functools.update_wrapper(self, kernel)
        self._kernel = kernel
        self._chunks_per_thread = chunks_per_thread

    def __call__(self, count: int, /, *args: P.args, **kwargs: P.kwargs) -> None:
        """Run iterations 0 to ``count`` on as many threads as torch uses, this one included; returns when all ended."""
        packed = self._kernel.pack(*args, **kwargs)
        threads = min(thread_count(), count)
        if threads <= 1:
            self._run(0, count, packed)
            return
        _stop_spinning()
        chunks = min(threads * self._chunks_per_thread, count)
        ranges = iter([(count * n // chunks, count * (n + 1) // chunks) for n in range(chunks)])

        def work() -> None:
            for start, stop in ranges:
                self._run(start, stop, packed)

        others = [_pool.submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            wait(others)  # they write into the caller's arrays
        for other in others:
            other.result()

    def _run(self, start: int, stop: int, packed: bytes) -> None:
        if self._kernel.function(start, stop, packed):
            raise MemoryError(f"kernel {self._kernel.name}: no memory for its buffers")


def parallel_kernel(chunks_per_thread: int = 1) -> Callable[[Callable[Concatenate[int, P], None]], ParallelKernel[P]]:
    """A `kernel` whose loop runs on several threads.

    The declaration's first argument is the number of iterations; C gets a range of them as ``start`` and ``stop``, and
    returns 0, or 1 where it lacks memory, which raises MemoryError. Iterations must not depend on each other: the
    result is the same to the bit for any number of threads. ``chunks_per_thread``: above 1 where costs differ."""

    def decorate(declaration: Callable[Concatenate[int, P], None]) -> ParallelKernel[P]:
        return ParallelKernel(Kernel(declaration, skip=1), chunks_per_thread)

    return decorate


def thread_count() -> int:
    """As many as torch uses, or would use."""
    # None where torch is not loaded; without the function while another thread is just loading it.
    return getattr(sys.modules.get("torch"), "get_num_threads", _count_of_environment)()


def _count_of_environment() -> int:
    count = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(count) if count.isdecimal() and int(count) > 0 else len(os.sched_getaffinity(0))


@functools.cache
def _stop_spinning() -> None:
    """Make torch's OpenMP threads sleep between operations where torch was loaded before this package; leave OpenBLAS
    one thread where numpy was.

    By default GNU OpenMP lets its threads spin for about 3 ms after each operation, so that a step of the mapper takes
    15 times as long, but next to not at all once it manages more threads than there are cores. One more team of
    threads, which belongs to a thread that sleeps for good, sees to that."""
    if semantic_mapper.BLAS_THREADS:
        threadpool_limits(1, "blas")
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


def _new_pool() -> None:
    global _pool
    _pool = ThreadPoolExecutor(MAX_POOL_THREADS, thread_name_prefix="kernel")


_new_pool()
os.register_at_fork(after_in_child=_new_pool)  # a child has none of its parent's threads
