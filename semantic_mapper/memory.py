"""What the C library does with memory that a process gives back."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt(3)
_SHORTAGE = ("failed to map segment", "annot allocate memory", "can't allocate memory", "std::bad_alloc")
LARGEST = 1 << 30  # bytes: tensors of a step are smaller


def keep_freed_memory() -> bool:
    """Let this process use freed memory again instead of returning it to the system, from now until it ends.

    By default glibc maps each large tensor anew and unmaps it when it is freed, and the kernel clears its pages every
    time. The price is that memory stays the process's own at its peak. For processes that do the same work over and
    over; the library itself never calls this.

    Returns:
        Whether it could be set: other C libraries than glibc have no such switch.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(_MMAP_THRESHOLD, LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, 2 * LARGEST - 1))


def give_back_freed_memory() -> bool:
    """Return what this process has freed, and the C library still holds in pieces, to the system, once.

    A process that runs for hours holds more and more of it, up to a bound: between blocks that live long lie holes. It
    takes some milliseconds; the library itself never calls this.

    Returns:
        Whether the C library can do that.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return False
    trim(0)
    return True


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a lack of memory, or of address space (``ulimit -v``), is behind an error.

    Libraries that cannot be mapped fail to import, and tensors that find no room raise ``RuntimeError``.
    """
    text = str(error)
    return isinstance(error, MemoryError) or (
        any(words in text for words in _SHORTAGE) and "static TLS" not in text  # loaded too late: another fault
    )


def memory_message(error: BaseException) -> str:
    """What to say where memory does not suffice."""
    reason = str(error) or type(error).__name__
    return f"not enough memory or address space ({reason}); free some, or raise the limit (ulimit -v)"
