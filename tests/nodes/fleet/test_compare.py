"""The release gate: what it calls worse, what it does not, and how sure it is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from semantic_mapper.errors import ConfigError, FleetError
from semantic_mapper.nodes.fleet.compare import (
    Estimate,
    GateOptions,
    compare_fleets,
    compare_results,
)
from semantic_mapper.nodes.fleet.metrics import Direction, direction_of
from semantic_mapper.nodes.fleet.operations import changed_settings, read_settings
from semantic_mapper.nodes.fleet.results import ClassRow, Failure, Findings, SegmentRow, TaskResult
from semantic_mapper.nodes.fleet.store import Store
from tests.nodes.fleet.made_up import FINISHED_NS, VERSION, made_up, store_of

OTHER: dict[str, Any] = {"version": "0.2.0+bbbbbbb", "code": "d" * 64}


def pairs(count: int, **changes: Any) -> list[tuple[TaskResult, TaskResult]]:
    return [(made_up(n), made_up(n, **changes)) for n in range(count)]


def with_findings(result: TaskResult, **changes: Any) -> TaskResult:
    return msgspec.structs.replace(result, findings=msgspec.structs.replace(result.findings, **changes))


def test_a_rerun_with_the_same_results_is_not_worse(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(6)]
    a, b = store_of(tmp_path / "a", results), store_of(tmp_path / "b", results)
    found = compare_fleets(a, b, GateOptions(threshold=0.0, log_threshold=0.0))
    assert not found.worse and found.count("same") == 6
    assert found.overall is not None and (found.overall.low, found.overall.high) == (0, 0)


def test_reruns_with_noise_are_rarely_worse_and_real_losses_are_found() -> None:
    assert sum(compare_results(pairs(12, noise=0.02, noise_seed=s), GateOptions()).worse for s in range(1, 9)) <= 2
    found = compare_results(pairs(12, noise=0.02, noise_seed=1, loss=0.02), GateOptions())
    assert found.worse and "the mean of miou over logs is worse" in found.reasons
    assert found.count("worse") == 0  # one point and a half: less than a single log may lose


def test_one_log_that_lost_much_is_found_among_many() -> None:
    both = [(made_up(n), made_up(n, loss=0.15 if n == 17 else 0.0, noise=0.02, noise_seed=2)) for n in range(40)]
    found = compare_results(both, GateOptions())
    assert found.worse and [log.log for log in found.logs if log.status == "worse"] == ["/logs/0017.mcap"]
    assert found.logs[0].log == "/logs/0017.mcap"
    assert found.reasons == ("1 log lost more than 0.02",)


def test_logs_that_got_better_are_no_alarm() -> None:
    found = compare_results(pairs(10, loss=-0.08), GateOptions())
    assert not found.worse and found.count("better") == 10


def test_a_threshold_allows_a_small_loss() -> None:
    both = pairs(10, loss=0.02, noise=0.01, noise_seed=3)
    assert compare_results(both, GateOptions()).worse
    assert not compare_results(both, GateOptions(threshold=0.03)).worse


def test_logs_that_failed_or_are_missing_are_worse_and_say_why(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(4)]
    a, b = store_of(tmp_path / "a", results), store_of(tmp_path / "b", results[:2])
    failed = results[2]
    b.quarantine(Failure(failed.key, "replay", failed.log, {}, VERSION, ("LogError: cut off",), FINISHED_NS))
    found = compare_fleets(a, b, GateOptions())
    assert [(log.status, log.reason) for log in found.logs[:2]] == [("failed", "LogError: cut off"), ("missing", "")]
    assert found.reasons == ("1 log failed in B", "1 log missing in B")
    reverse = compare_fleets(b, a, GateOptions())
    assert not reverse.worse and reverse.new == tuple(result.log for result in results[2:])


def test_a_candidate_whose_logs_all_failed_is_worse(tmp_path: Path) -> None:
    results = [made_up(n) for n in range(3)]
    a, b = store_of(tmp_path / "a", results), Store(str(tmp_path / "b"), create=True)
    nothing = compare_fleets(a, b, GateOptions(costs={"seconds": 0.1}))
    assert nothing.reasons == ("3 logs missing in B",) and "no results" in nothing.b
    for n, result in enumerate(results[:2]):
        b.quarantine(Failure(f"k{n}", "replay", result.log, {}, "0.2.0", ("LogError: cut off",), FINISHED_NS))
    found = compare_fleets(a, b, GateOptions())
    assert found.reasons == ("2 logs failed in B", "1 log missing in B") and "0.2.0, no results" in found.b
    assert [log.reason for log in found.logs] == ["LogError: cut off"] * 2 + [""]
    assert json.loads(json.dumps(found.to_plain(), allow_nan=False))["mean_a"] is None


@pytest.mark.parametrize("wanted", [{}, {"version": "0.2.0"}])
def test_a_later_version_with_failures_only_is_worse(tmp_path: Path, wanted: dict[str, str]) -> None:
    results = [made_up(n) for n in range(3)]
    store = store_of(tmp_path / "store", results)
    for n, result in enumerate(results):
        store.quarantine(Failure(f"k{n}", "replay", result.log, {}, "0.2.0", ("E: no",), FINISHED_NS + 10**15))
    found = compare_fleets(store, store, GateOptions(a={"version": "0.1.0"}, b=wanted))
    assert found.reasons == ("3 logs failed in B",)
    assert not compare_fleets(store, store, GateOptions(b={"version": "0.1.0"})).worse


def test_a_log_without_a_score_in_b_is_worse() -> None:
    a, b = made_up(1), made_up(1)
    both = [*pairs(3), (with_findings(a, segments=()), with_findings(b, segments=(), metrics={"miou": None}))]
    found = compare_results(both, GateOptions())
    assert found.count("unscored") == 1 and found.reasons == ("1 log without a score in B",)


def test_versions_in_one_store_are_compared_and_the_latest_counts(tmp_path: Path) -> None:
    old = [made_up(n) for n in range(4)]
    new = [made_up(n, loss=0.2, finished_ns=FINISHED_NS + 10**15, **OTHER) for n in range(4)]
    store = store_of(tmp_path / "store", [*old, *new])
    found = compare_fleets(store, store, GateOptions(a={"version": "0.1.0"}, b={"version": "0.2.0"}))
    assert found.worse and found.mean_b < found.mean_a
    assert found.mean_b == compare_fleets(store, store, GateOptions()).mean_a
    with pytest.raises(ConfigError, match=r"no results of `replay` have version=3.*0\.1\.0\+aaaaaaa"):
        compare_fleets(store, store, GateOptions(a={"version": "3"}))


def test_settings_in_one_store_are_compared(tmp_path: Path) -> None:
    given = {"quality=fast": 0.3, "render.scale=0.5": 0.2, "max_frames=3": 0.1, "moving.classes=true": 0.05}
    settings = {text: changed_settings(read_settings("replay", [text])) for text in given}
    results = [made_up(n, settings=settings[text], loss=loss) for text, loss in given.items() for n in range(3)]
    store = store_of(tmp_path / "store", [*results, *(made_up(n) for n in range(3))])
    for text in given:
        name, _, value = text.partition("=")
        found = compare_fleets(store, store, GateOptions(a={"weights": "small"}, b={name: value}))
        assert found.b.endswith(f", {text}"), "what --set takes is what --b takes"
    with pytest.raises(ConfigError, match=r"have quality=best; there are: .*quality=fast"):
        compare_fleets(store, store, GateOptions(b={"quality": "best"}))


def test_weights_that_were_not_named_are_the_default(tmp_path: Path) -> None:
    results = [made_up(n, weights=name, weights_digest=name or "d") for n in range(3) for name in ("", "small")]
    store = store_of(tmp_path / "store", results)
    found = compare_fleets(store, store, GateOptions(a={"weights": "default"}, b={"weights": "small"}))
    assert "weights default" in found.a and "weights small" in found.b and not found.worse


def test_a_variant_with_few_logs_is_noted(tmp_path: Path) -> None:
    few = made_up(0, finished_ns=FINISHED_NS + 10**15, **OTHER)
    store = store_of(tmp_path / "store", [*(made_up(n) for n in range(5)), few])
    (note,) = compare_fleets(store, store, GateOptions(b={"version": "0.2.0"})).notes[:1]
    assert "A has 1 log of 0.2.0+bbbbbbb" in note and "up to 5" in note


def test_metrics_without_stretches_are_judged_over_logs_together() -> None:
    rng = np.random.default_rng(0)
    both = [
        (
            with_findings(a, metrics={"depth_disagreement": 0.02}),
            with_findings(b, metrics={"depth_disagreement": 0.03 + 0.002 * rng.random()}),
        )
        for a, b in pairs(8)
    ]
    found = compare_results(both, GateOptions(metric="depth_disagreement"))
    assert found.direction == "lower is better" and found.worse and found.count("worse") == 0
    assert found.to_plain()["direction"] == "lower is better"
    assert not compare_results(both, GateOptions(metric="depth_disagreement", lower_is_better=False)).worse
    assert any("judged together only" in note for note in found.notes)


def test_a_metric_of_unknown_direction_is_not_judged_unless_the_user_says_so() -> None:
    with pytest.raises(FleetError, match=r"ate_m: it is not known .*--lower-is-better.* depth_disagreement, "):
        compare_results(pairs(4), GateOptions(metric="ate_m"))
    sized = [
        (with_findings(a, metrics={"blocks": 9.0}), with_findings(b, metrics={"blocks": 3.0})) for a, b in pairs(4)
    ]
    with pytest.raises(FleetError, match="blocks: neither more nor less of it is better"):
        compare_results(sized, GateOptions(metric="blocks"))
    assert compare_results(sized, GateOptions(metric="blocks", lower_is_better=False)).worse
    assert not compare_results(sized, GateOptions(metric="blocks", lower_is_better=True)).worse


def test_a_method_that_no_result_has_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no result has the method 'sray'; there are: replay"):
        compare_results(pairs(3), GateOptions(method="sray"))
    with pytest.raises(ConfigError, match="frames_fused is no metric of a method"):
        compare_results(pairs(3), GateOptions(method="replay", metric="frames_fused"))
    assert compare_results(pairs(6, loss=0.1), GateOptions(method="replay")).count("worse") == 6


def test_a_method_without_stretches_is_judged_by_its_own_figures() -> None:
    def with_map(result: TaskResult, miou: float) -> TaskResult:
        found = result.findings
        classes = (*found.classes, ClassRow("points of the map", "lamp", miou))
        return with_findings(result, classes=classes, metrics={**found.metrics, "miou points of the map": miou})

    both = [(with_map(a, 0.5), with_map(b, 0.4)) for a, b in pairs(4)]
    for metric in ("miou", "iou:lamp"):
        found = compare_results(both, GateOptions(metric=metric, method="points of the map"))
        assert (found.mean_a, found.mean_b) == (0.5, pytest.approx(0.4)) and found.worse
    assert not compare_results(both, GateOptions()).worse


def test_a_metric_without_values_is_not_among_those_that_there_are() -> None:
    results = [with_findings(a, metrics={**a.findings.metrics, "depth_disagreement": None}) for a, _ in pairs(2)]
    both = list(zip(results, results, strict=True))
    with pytest.raises(
        ConfigError, match="no result has a value of the metric 'depth_disagreement'; there are: "
    ) as error:
        compare_results(both, GateOptions(metric="depth_disagreement"))
    there = str(error.value).split("there are: ")[1]
    assert "depth_disagreement" not in there and "map_miou" in there


def test_a_class_can_be_the_metric() -> None:
    found = compare_results(pairs(6, loss=0.1), GateOptions(metric="iou:lamp"))
    assert found.worse and found.logs[0].a == pytest.approx(
        next(row.iou for row in made_up(int(found.logs[0].log[6:10])).findings.classes if row.name == "lamp"), abs=0.01
    )


def test_classes_are_compared_by_name() -> None:
    a = made_up(3)
    order = [2, 0, 3, 1]
    shuffled = tuple(
        SegmentRow(s.method, s.first, s.frames, tuple(s.names[i] for i in order), _reordered(s, order))
        for s in a.findings.segments
    )
    found = compare_results([(a, with_findings(a, segments=shuffled))], GateOptions(log_threshold=0.0))
    assert found.mean_a == found.mean_b and not found.worse


def _reordered(segment: SegmentRow, order: list[int]) -> tuple[int, ...]:
    counts = np.reshape(segment.counts, (4, 5))[order][:, [*order, 4]]
    return tuple(int(c) for c in counts.ravel())


def test_a_single_log_is_judged_by_its_stretches() -> None:
    found = compare_results(pairs(1, loss=0.05, noise=0.01, noise_seed=1), GateOptions())
    assert found.worse and found.overall == found.logs[0].estimate
    without = [(with_findings(a, segments=()), with_findings(b, segments=())) for a, b in pairs(1, loss=0.05)]
    unsure = compare_results(without, GateOptions())
    assert not unsure.worse and any("noise is unknown" in note for note in unsure.notes)


def test_stretches_that_one_side_lacks_do_not_count() -> None:
    a = made_up(5)
    found = compare_results([(a, with_findings(a, segments=a.findings.segments[:8]))], GateOptions())
    assert found.overall is not None and found.overall.freedom == 7 and found.overall.difference == 0
    assert any("in one of the results only" in note for note in found.notes)


def test_costs_stop_a_release_only_where_asked_for() -> None:
    both = [(a, with_findings(b, costs={"step_ms_p50": 1.3 * a.findings.costs["step_ms_p50"]})) for a, b in pairs(6)]  # type: ignore[operator]
    free = compare_results(both, GateOptions())
    (cost,) = [cost for cost in free.costs if cost.name == "step_ms_p50"]
    assert not free.worse and cost.ratio == pytest.approx(1.3)
    assert compare_results(both, GateOptions(costs={"step_ms_p50": 0.2})).worse
    assert not compare_results(both, GateOptions(costs={"step_ms_p50": 0.4})).worse
    with pytest.raises(ConfigError, match=r"--cost step_ms: .*step_ms_p50"):
        compare_results(both, GateOptions(costs={"step_ms": 0.2}))


def test_what_cannot_be_compared_says_what_there_is(tmp_path: Path) -> None:
    a = store_of(tmp_path / "a", [made_up(1), made_up(1, operation="eval")])
    b = store_of(tmp_path / "b", [made_up(2), made_up(2, operation="eval")])
    with pytest.raises(ConfigError, match=r"--operation.*eval, replay"):
        compare_fleets(a, b, GateOptions())
    with pytest.raises(ConfigError, match="no log has results of `eval` in both"):
        compare_fleets(a, b, GateOptions(operation="eval"))
    with pytest.raises(ConfigError, match="ate_m, frames_fused"):
        compare_fleets(a, a, GateOptions(operation="eval", metric="moiu"))
    with pytest.raises(ConfigError, match="finetune"):
        compare_fleets(a, a, GateOptions(operation="finetune"))


def test_the_result_is_json_also_where_there_are_no_numbers() -> None:
    both = [(msgspec.structs.replace(a, findings=Findings({"score": 1.0})),) * 2 for a, _ in pairs(1)]
    plain = compare_results(both, GateOptions(metric="score", lower_is_better=False)).to_plain()
    assert json.loads(json.dumps(plain, allow_nan=False))["overall"] is None


def test_intervals_and_p_values_are_students() -> None:
    estimate = Estimate(-0.03, 0.01, 11, 0.0, 0.0)
    assert estimate.p_below(0.0) == pytest.approx(0.00604, abs=1e-4)  # t = -3 with 11 degrees of freedom
    assert estimate.p_below(-0.02) > 0.1
    assert Estimate(0.0, 0.0, 11, 0.0, 0.0).p_below(0.0) == 1.0


@pytest.mark.parametrize(
    ("metric", "direction"),
    [
        ("miou", Direction.HIGHER),
        ("miou own image alone", Direction.HIGHER),
        ("iou:error_m", Direction.HIGHER),
        ("frames_fused", Direction.HIGHER),
        ("ece", Direction.LOWER),
        ("unknown", Direction.LOWER),
        ("depth_disagreement", Direction.LOWER),
        ("frames_left_out", Direction.LOWER),
        ("frames_without_depth", Direction.LOWER),
        ("frames_excluded_from_scores", Direction.LOWER),
        ("steps", Direction.NEITHER),
    ],
)
def test_directions_of_metrics(metric: str, direction: Direction) -> None:
    assert direction_of(metric) == direction


def test_stores_of_many_versions_give_one_pair_a_log(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "store"), create=True)
    for number in range(3):
        for code in "abc":
            store.commit(made_up(number, code=code * 64, version=f"0.{ord(code)}"))
    assert len(compare_fleets(store, store, GateOptions()).logs) == 3
