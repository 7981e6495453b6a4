"""What is missing between the frames of a log, camera by camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from semantic_mapper.plain_text import counted

LONG_INTERVAL = 2.5  # times the median interval; one dropped frame makes 2


def find_missing_frames(seqs: Sequence[int], stamps_ns: Sequence[int]) -> dict[str, Any]:
    """Frames that are missing from those of one camera, by its sequence numbers and times of capture; plain data.

    A camera that is recorded every n-th frame misses none: n is the median step of its sequence numbers. Intervals
    count from ``LONG_INTERVAL`` times ``interval_s`` on, the median (null below two frames).
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
        "sequence_gap_count": int((missing > 0).sum()),
        "largest_sequence_gap": int(missing[at]) if len(missing) else 0,
        "largest_sequence_gap_after_seq": int(seqs[at]) if missing.any() else None,
        "time_gap_count": int(long.sum()),
        "longest_time_gap_s": round(int(intervals[later]) / 1e9, 3) if long.any() else None,
        "longest_time_gap_after_seq": int(seqs[later]) if long.any() else None,
        "interval_s": None if typical is None else round(typical / 1e9, 6),
        "counter_restarts": int((steps <= 0).sum()),
        "stamps_not_increasing": int((intervals <= 0).sum()),
    }


def missing_frames_text(missing: dict[str, Any]) -> str:
    """What ``find_missing_frames`` found, for people."""
    parts: list[str] = []
    if missing["frames_missing"]:
        gap = counted(missing["sequence_gap_count"], "gap")
        parts.append(
            f"{counted(missing['frames_missing'], 'frame')} missing in {gap} of the sequence numbers (largest "
            f"{missing['largest_sequence_gap']}, after seq {missing['largest_sequence_gap_after_seq']})"
        )
    if missing["time_gap_count"]:
        parts.append(
            f"{counted(missing['time_gap_count'], 'time gap')} (longest {missing['longest_time_gap_s']:g} s, after seq "
            f"{missing['longest_time_gap_after_seq']}; typical interval {missing['interval_s']:.3g} s)"
        )
    if missing["counter_restarts"]:
        parts.append(f"sequence numbers begin again {counted(missing['counter_restarts'], 'time')}")
    if missing["stamps_not_increasing"]:
        count = missing["stamps_not_increasing"]
        parts.append(f"{counted(count, 'stamp')} {'is' if count == 1 else 'are'} not later than the one before")
    return "; ".join(parts) or "none"
