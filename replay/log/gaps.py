"""What is missing between the frames of a log, camera by camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from semantic_mapper.plain_text import counted

LONG_INTERVAL = 2.5  # times the median interval; one dropped frame makes 2


def find_gaps(seqs: Sequence[int], stamps_ns: Sequence[int]) -> dict[str, Any]:
    """The gaps of one camera's frames.

    A camera that is recorded every n-th frame has no gaps: n is the median step of its sequence numbers.

    Args:
        seqs: Sequence numbers in the order of the log.
        stamps_ns: Times of capture, as many.

    Returns:
        Plain data: ``frames_missing`` and in how many ``sequence_gaps``; ``time_gaps`` longer than ``LONG_INTERVAL``
        times ``interval_s``, the median (null below two frames); of both the largest and the sequence number before
        it; ``counter_restarts``, where numbers begin again; ``stamps_not_increasing``.
    """
    steps = np.diff(np.asarray(seqs, np.int64))
    onward = steps > 0
    stride = int(np.percentile(steps[onward], 50, method="lower")) if onward.any() else 1
    missing = np.where(onward, steps // stride - 1, 0).clip(min=0)
    intervals = np.diff(np.asarray(stamps_ns, np.int64))
    forward = intervals > 0
    typical = float(np.median(intervals[forward])) if forward.any() else None
    long = intervals > LONG_INTERVAL * typical if typical is not None else np.zeros(len(intervals), bool)
    at, later = (int(x.argmax()) if len(x) else 0 for x in (missing, intervals))
    return {
        "frames_missing": sum(missing.tolist()),
        "sequence_gaps": int((missing > 0).sum()),
        "largest_sequence_gap": int(missing[at]) if len(missing) else 0,
        "largest_sequence_gap_after_seq": int(seqs[at]) if missing.any() else None,
        "time_gaps": int(long.sum()),
        "longest_time_gap_s": round(int(intervals[later]) / 1e9, 3) if long.any() else None,
        "longest_time_gap_after_seq": int(seqs[later]) if long.any() else None,
        "interval_s": None if typical is None else round(typical / 1e9, 6),
        "counter_restarts": int((steps <= 0).sum()),
        "stamps_not_increasing": int((intervals <= 0).sum()),
    }


def gaps_text(gaps: dict[str, Any]) -> str:
    """What ``find_gaps`` found, for people."""
    parts: list[str] = []
    if gaps["frames_missing"]:
        gap = counted(gaps["sequence_gaps"], "gap")
        parts.append(
            f"{counted(gaps['frames_missing'], 'frame')} missing in {gap} of the sequence numbers (largest "
            f"{gaps['largest_sequence_gap']}, after seq {gaps['largest_sequence_gap_after_seq']})"
        )
    if gaps["time_gaps"]:
        parts.append(
            f"{counted(gaps['time_gaps'], 'time gap')} (longest {gaps['longest_time_gap_s']:g} s, after seq "
            f"{gaps['longest_time_gap_after_seq']}; typical interval {gaps['interval_s']:.3g} s)"
        )
    if gaps["counter_restarts"]:
        parts.append(f"sequence numbers begin again {counted(gaps['counter_restarts'], 'time')}")
    if gaps["stamps_not_increasing"]:
        count = gaps["stamps_not_increasing"]
        parts.append(f"{counted(count, 'stamp')} {'is' if count == 1 else 'are'} not later than the one before")
    return "; ".join(parts) or "none"
