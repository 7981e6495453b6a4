"""What the C library does with memory that a process gives back, and what is said where memory does not suffice."""

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt(3)
_SHORTAGE = ("failed to map segment", "annot allocate memory", "can't allocate memory", "std::bad_alloc")
_NO_THREAD = "Resource temporarily unavailable"  # what OpenVINO says where the system gives it no thread
LARGEST = 1 << 30  # bytes: tensors of a step are smaller
# What mapping the demo takes, libraries included: it fails with 1.2 GB of address space, and holds 0.4 GB at most.
NEEDED_ADDRESS_SPACE_GB, NEEDED_MEMORY_GB = 2, 0.5
_MAX_REASON = 160  # letters: NumPy explains a failed import on two pages


def keep_freed_memory() -> None:
    """Let this process use freed memory again instead of returning it to the system, from now until it ends.

    By default glibc maps each large tensor again and unmaps it when it is freed, and the kernel clears its pages every
    time. The price is that memory stays the process's own at its peak. For processes that do the same work over and
    over; the library itself never calls this.
    """
    glibc = ctypes.CDLL(None)
    glibc.mallopt(_MMAP_THRESHOLD, LARGEST)
    glibc.mallopt(_TRIM_THRESHOLD, 2 * LARGEST - 1)


def give_back_freed_memory() -> None:
    """Return what this process has freed, and the C library still holds in pieces, to the system, once.

    A process that runs for hours holds more and more of it, up to a bound: between blocks that live long lie holes. It
    takes some milliseconds; the library itself never calls this.
    """
    ctypes.CDLL(None).malloc_trim(0)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether a lack of memory, or of address space (``ulimit -v``), is behind an error.

    Libraries that cannot be mapped fail to import, and tensors that find no room raise ``RuntimeError``.
    """
    return any(map(_says_shortage, _with_causes(error)))


def memory_message(error: BaseException) -> str:
    """What to say where memory does not suffice: one line."""
    says = str(next((e for e in _with_causes(error) if _says_shortage(e)), error)).strip()
    lines = says.splitlines() or ["no memory left"]
    reason = next((line for line in lines if any(words in line for words in (*_SHORTAGE, _NO_THREAD))), lines[0])
    return (
        f"not enough memory or address space ({reason[:_MAX_REASON]}); semantic-mapper needs about "
        f"{NEEDED_ADDRESS_SPACE_GB:g} GB of address space and {NEEDED_MEMORY_GB:g} GB of memory, and more for large "
        "maps: free some, or raise the limit (ulimit -v; ulimit -u where it is one of threads)"
    )


def _with_causes(error: BaseException) -> list[BaseException]:
    errors: list[BaseException] = []
    following: BaseException | None = error
    while following is not None and following not in errors:
        errors.append(following)
        following = following.__cause__ or following.__context__
    return errors


def _says_shortage(error: BaseException) -> bool:
    text = str(error)
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _NO_THREAD in text):
        return True
    return any(words in text for words in _SHORTAGE) and "static TLS" not in text  # loaded too late: another fault
