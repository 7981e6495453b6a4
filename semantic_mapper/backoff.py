"""How long to wait before something that has failed is tried again."""

from __future__ import annotations


def backoff_s(failures: int, first_s: float, max_s: float) -> float:
    """Pause after this many failures in a row: ``first_s`` after the first, twice as long after each further one.

    Args:
        failures: From 1.
        first_s: Seconds.
        max_s: The longest pause, seconds.
    """
    return min(first_s * 2.0 ** min(failures - 1, 64), max_s)
