"""The fault table's own parts, and those of its cases that need no launch."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest

from research.experiments import fault_finetuner, fault_frames, fault_inputs, fault_table, long_log, soak
from research.experiments.fault_table import Outcome
from semantic_mapper.replay.log.format import LogReader


def test_the_table_shows_the_worst_of_each_case(tmp_path: Path) -> None:
    outcomes = [
        Outcome("kill", 0.5, lost_frames=3, counts={"blocks": 5}),
        Outcome("kill", 1.5, lost_frames=9, lost_messages=1, counts={"blocks": 7}),
        Outcome("flood", 0.1, others=1),
    ]
    table = fault_table.write(outcomes, tmp_path / "faults", {"machine": "two cores"})
    assert "| kill | 2 | 0.50 / 1.50 / 1.50 | 3 / 9 | 1 | 0 | 0 | 0 | 12 blocks |" in table
    assert "| flood | 1 | 0.10 / 0.10 / 0.10 | 0 / 0 | 0 | 0 | 1 | 0 |  |" in table
    told = json.loads((tmp_path / "faults.json").read_text())
    assert len(told["outcomes"]) == 3 and told["about"] == {"machine": "two cores"}
    assert (tmp_path / "faults.md").read_text().startswith("machine: two cores\n")


def test_a_camera_that_was_unplugged_comes_back() -> None:
    (outcome,) = fault_frames.unplugged_cameras(1)
    assert outcome.others == 0


@pytest.mark.slow
def test_a_finetuner_that_is_killed_or_frozen_is_back_with_its_keyframes(tmp_path: Path) -> None:
    log = long_log.write_long_log(tmp_path / "long.mcap", 400.0, 5.0)
    killed, frozen = fault_finetuner.finetuner_faults([f"camera.log={log}"], tmp_path / "launch", 1)
    assert (killed.case, frozen.case) == ("kill -9 finetuner", "SIGSTOP finetuner")
    for outcome in (killed, frozen):
        assert outcome.counts["keyframes lost"] == outcome.others == 0


def test_bad_messages_are_all_bad_and_of_many_kinds() -> None:
    for target in ("message", "question", "pose"):
        found = fault_inputs.bad_messages(target, 1, 200)
        assert len(found) == 200 and len({b"|".join(parts) for parts in found}) > 150


def test_a_long_log_is_a_short_walk_with_new_stamps(tmp_path: Path) -> None:
    with LogReader(long_log.write_long_log(tmp_path / "long.mcap", 2.0, 30.0)) as log:
        frames = list(log)
    assert [f.seq for f in frames] == list(range(60))
    assert all(b.stamp_ns > a.stamp_ns for a, b in itertools.pairwise(frames))
    there, back = frames[long_log.DISTINCT - 2], frames[long_log.DISTINCT]
    assert (there.T_world_camera == back.T_world_camera).all() and (there.depth_m == back.depth_m).all()


def test_the_soak_is_judged_by_slopes_ages_and_counts(tmp_path: Path) -> None:
    def samples(mb_min: float) -> soak.Samples:
        made = soak.Samples()
        for second in range(600):
            made.at_s.append(float(second))
            made.rss_mb.append(100.0 + mb_min * second / 60)
            made.files.append(20)
            made.counters.append({"fused": second * 10, "restarts": 0})
            made.ages_s.append({})
        return made

    summary = {"frames": {"published": 100, "fused": 60, "refused": 1, "dropped": 39}}
    seen = {"mapper": samples(0.2), "camera": samples(0.0)}
    report = soak.judge(seen, [0.05] * 100, 100, summary, 60.0)
    assert all(report["good"].values())
    assert abs(report["processes"]["mapper"]["rss_slope_mb_min"] - 0.2) < 1e-6
    assert abs(report["mapper_period_s"] - 0.1) < 1e-6
    assert not soak.judge(seen, [0.3] * 100, 100, summary, 60.0)["good"]["age"]
    assert not soak.judge(seen, [0.05] * 100, 101, summary, 60.0)["good"]["drops"]
    assert not soak.judge({"mapper": samples(2.0)}, [0.05] * 100, 100, summary, 60.0)["good"]["memory"]
    soak.draw(seen, [(0.5, 40.0), (1.5, 50.0)], tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 1000
    assert "-> " not in soak.markdown(report) and "39 counted as dropped; 39 are missing" in soak.markdown(report)
