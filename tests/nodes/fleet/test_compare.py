"""The release gate: what it calls worse, what it does not, and how sure it is."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import to_builtins
from msgspec.structs import replace

from semantic_mapper.errors import ConfigError
from semantic_mapper.nodes.fleet.results import FleetComparison, compare_stores
from semantic_mapper.nodes.fleet.store import TaskResult
from tests.contract.golden import form, undocumented
from tests.nodes.fleet.made_up import FINISHED_NS, failure_of, made_up, store_of


@pytest.fixture
def compared(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Compares two lists of results."""

    def compare(before: Sequence[TaskResult], after: Sequence[TaskResult], **options: Any) -> FleetComparison:
        a, b = (store_of(tmp_path_factory.mktemp("store"), found) for found in (before, after))
        return compare_stores(a, b, **options)

    return compare


def logs(count: int, **changes: Any) -> list[TaskResult]:
    return [made_up(n, **changes) for n in range(count)]


def with_findings(result: TaskResult, **changes: Any) -> TaskResult:
    return replace(result, findings=replace(result.findings, **changes))


def test_reruns_are_rarely_worse_and_real_losses_are_found(compared: Any) -> None:
    same = compared(logs(6), logs(6), log_threshold=0.0)
    assert not same.reasons and same.count("same") == 6 and same.interval == (0, 0)
    reruns = [compared(logs(12), logs(12, noise=0.02, noise_seed=seed)) for seed in range(1, 7)]
    assert sum(bool(found.reasons) for found in reruns) <= 1
    found = compared(logs(12), logs(12, noise=0.02, noise_seed=1, loss=0.02))
    assert found.reasons == ("the mean of miou over logs is worse",)  # less than a single log may lose


def test_the_interval_is_that_of_the_paired_differences(compared: Any) -> None:
    found = compared(logs(5), logs(5, noise=0.02, noise_seed=3))
    d = np.array([log.b - log.a for log in found.logs])
    reach = 2.776445 * d.std(ddof=1) / 5**0.5  # Student's 97.5th percentile of 4 degrees of freedom
    np.testing.assert_allclose(found.interval, (d.mean() - reach, d.mean() + reach), rtol=1e-5)
    assert found.b - found.a == pytest.approx(d.mean())


def test_one_log_that_lost_much_is_found_among_many_and_comes_first(compared: Any) -> None:
    after = [made_up(n, loss=0.15 if n == 17 else 0.0, noise=0.02, noise_seed=2) for n in range(30)]
    found = compared(logs(30), after)
    assert [log.log for log in found.logs if log.status == "worse"] == ["/logs/0017.mcap"] == [found.logs[0].log]
    assert found.reasons == ("1 log worse by more than 0.05",)
    assert undocumented("fleet compare", form({"worse": True, **to_builtins(found)})) == []


def test_logs_that_got_better_are_no_alarm_and_a_threshold_allows_a_small_loss(compared: Any) -> None:
    better = compared(logs(8), logs(8, loss=-0.08))
    assert not better.reasons and better.count("better") == 8
    assert compared(logs(8), logs(8, loss=0.02)).reasons
    assert not compared(logs(8), logs(8, loss=0.02), threshold=0.03).reasons


def test_logs_that_failed_or_are_missing_are_worse_and_say_why(tmp_path: Path) -> None:
    results = logs(4)
    a, b = store_of(tmp_path / "a", results), store_of(tmp_path / "b", results[:2])
    b.note_failure(failure_of(results[2]))
    found = compare_stores(a, b)
    assert [(log.status, log.reason) for log in found.logs[:2]] == [("failed", "LogError: cut off"), ("missing", "")]
    assert found.reasons == ("1 log failed in B", "1 log missing in B")
    assert not compare_stores(b, a).reasons
    unscored = store_of(tmp_path / "d", [*results[:3], with_findings(results[3], metrics={"miou": None})])
    assert compare_stores(a, unscored).reasons == ("1 log without a score in B",)
    nothing = compare_stores(a, store_of(tmp_path / "c"))
    assert nothing.reasons == ("4 logs missing in B",) and nothing.a is None


def test_costs_are_judged_over_logs_together(compared: Any) -> None:
    slower = [with_findings(r, costs={"step_ms_p50": 36.0 + n % 2}) for n, r in enumerate(logs(8))]
    found = compared(logs(8), slower, metric="step_ms_p50")
    assert found.lower_is_better and found.count("worse") == 0
    assert found.reasons == ("the mean of step_ms_p50 over logs is worse",)
    assert not compared(logs(8), slower, metric="step_ms_p50", threshold=20).reasons
    assert not compared(slower, logs(8), metric="step_ms_p50").reasons


def test_one_log_alone_has_its_limit(compared: Any) -> None:
    found = compared(logs(1), logs(1, loss=0.1))
    assert found.interval is None and found.reasons == ("1 log worse by more than 0.05",)
    assert not compared(logs(1), logs(1, loss=0.04)).reasons


def test_a_class_a_method_and_the_latest_result_can_decide(compared: Any) -> None:
    found = compared(logs(6), logs(6, loss=0.1), metric="iou:lamp")
    assert found.count("worse") == 6
    named = [
        [with_findings(r, metrics={"miou map": r.findings.metrics["miou"]}) for r in results]
        for results in (logs(6), logs(6, loss=0.1))
    ]
    assert compared(*named, metric="miou map").count("worse") == 6
    later = made_up(0, loss=0.3, version="0.2.0", finished_ns=FINISHED_NS + 10**15)
    found = compared(logs(3), [*logs(3), later])
    assert found.count("worse") == 1 and found.logs[0].log == later.log


def test_what_cannot_be_compared_says_what_there_is(compared: Any) -> None:
    both = [made_up(1), made_up(1, operation="eval")]
    for pair, options, said in (
        ((both, both), {}, r"\(--operation\): eval, map"),
        ((both, both), {"operation": "finetune"}, r"\(--operation\): eval, map"),
        (([made_up(1)], [made_up(2)]), {}, "no log has results of `map` in both"),
        ((both, both), {"operation": "eval", "metric": "moiu"}, "'moiu'; did you mean `miou`"),
    ):
        with pytest.raises(ConfigError, match=said):
            compared(*pair, **options)
