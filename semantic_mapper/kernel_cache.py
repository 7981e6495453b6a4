"""Compiled kernels on disk, safe where several processes compile at once and where a kernel's callee has changed."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import contextlib
import fcntl
import functools
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, TypeVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from semantic_mapper.log_events import get_logger

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parent
_MARKS = (b"njit", b"_kernel", b"@kernel")

_log = get_logger(__name__)


def kernel(
    *,
    inline: bool = False,
    fastmath: bool = False,
    error_model: Literal["python", "numpy"] = "python",
) -> Callable[[FunctionT], FunctionT]:
    """``numba.njit`` without the GIL, kept on disk by `KernelCache`.

    Args:
        inline: Put the function into its callers before types are known.
        fastmath: Let LLVM round otherwise than IEEE 754 says.
        error_model: ``"python"`` (division by zero raises) or ``"numpy"`` (it gives inf or NaN, and vectorises).
    """
    compile_: Any = numba.njit(
        nogil=True,
        inline="always" if inline else "never",
        fastmath=fastmath,
        error_model=error_model,
    )

    def decorate(function: FunctionT) -> FunctionT:
        dispatcher = compile_(function)
        try:
            # As numba's own `enable_caching` does for `cache=True`, which offers no choice of the cache.
            dispatcher._cache = KernelCache(function)
        except RuntimeError as error:  # neither the package's folder nor the user's cache folder can be written to
            _log_no_cache(str(_PACKAGE), type(error).__name__)
        return dispatcher

    return decorate


class KernelCache(FunctionCache):
    """Numba's cache of one function's machine code, with what it lacks.

    - A lock. Two processes that save two signatures of a function at once would give both the same file name, and the
      next process would run the code of one signature on the arguments of the other.
    - A stamp of all kernels' sources. Numba looks at the file of the outermost function alone, and would go on running
      old code of another file that it had compiled into it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self.cache_path, filename_base=self._impl.filename_base, source_stamp=kernels_stamp()
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Machine code for the signature, or None."""
        with self._locked(fcntl.LOCK_SH):
            return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep machine code for the signature."""
        with self._locked(fcntl.LOCK_EX):
            super().save_overload(sig, data)

    @contextlib.contextmanager
    def _locked(self, kind: int) -> Iterator[None]:
        folder = Path(self.cache_path)
        folder.mkdir(parents=True, exist_ok=True)  # it may have been cleared since this process began
        with (folder / "kernels.lock").open("ab") as file:
            try:
                fcntl.flock(file, kind)
            except OSError as error:  # a network file system that has no locks
                _log_no_lock(self.cache_path, str(error))
            yield


@functools.cache
def _log_no_lock(folder: str, error: str) -> None:
    _log.warning("kernels_without_lock", folder=folder, error=error, note="start one process first, then the others")


@functools.cache
def _log_no_cache(folder: str, error: str) -> None:
    note = "kernels compile at every start, for about two minutes; set NUMBA_CACHE_DIR to a writable folder"
    _log.warning("kernels_not_kept", folder=folder, error=error, note=note)


@functools.cache
def kernels_stamp() -> str:
    """Digest of all files of this package in which kernels stand."""
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        text = path.read_bytes()
        if any(mark in text for mark in _MARKS):
            digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + text)
    return digest.hexdigest()
