"""A short run of the fuzzing of frame values; the long one is ``python -m research.experiments.fuzz --frames``."""

from __future__ import annotations

from research.experiments import fuzz_values


def test_hostile_values_are_refused_the_rest_is_mapped_and_memory_stays() -> None:
    report = fuzz_values.run(400, seed=0)
    assert report.frames == 400 == report.counts.total()
    assert report.counts["mapped"] > 100
    assert report.counts["refused by the codec"] > 50 and report.counts["refused by the mapper"] > 20
    assert report.peak_growth_mb < fuzz_values.MAX_GROWTH_MB


def test_the_same_seed_gives_the_same_frames() -> None:
    one, other, third = fuzz_values.FrameMaker(3), fuzz_values.FrameMaker(3), fuzz_values.FrameMaker(4)
    frames = [one.next() for _ in range(40)]
    assert frames == [other.next() for _ in range(40)] != [third.next() for _ in range(40)]
    assert {"ordinary"} < {told for _, told in frames}
