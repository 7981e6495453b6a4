"""Which logs got better or worse from one set of results to another, beyond noise: a gate for releases.

Noise of a log: a paired block bootstrap. Stretches of consecutive frames are drawn with replacement, the same ones for
both results (Künsch 1989; Efron and Tibshirani 1993). The spread of the difference over the draws is its standard
error; intervals and p-values are Student's with one degree of freedom less than there are stretches: percentiles of the
draws would be too narrow for a dozen stretches, and know no p-value below one in the number of draws. Noise of the mean
over logs: the same over logs, whose standard error has a closed form. Many logs: Benjamini-Hochberg, which names a log
as rarely as Bonferroni-Holm where none is worse, and finds more where some are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import false_discovery_control, t

from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import miou_of_sums
from semantic_mapper.nodes.fleet.store import Store, TaskResult
from semantic_mapper.plain_text import counted
from semantic_mapper.types import Float64

_RESAMPLES = 1000
_CONFIDENCE = 0.95  # of intervals; a fleet that is no worse is called worse in at most one of twenty comparisons

WORSE, BETTER, SAME = "worse", "better", "same"
# Of logs that have a score in A only.
FAILED, MISSING, UNSCORED = "failed", "missing", "unscored"
_BAD = {FAILED: "failed in B", MISSING: "missing in B", UNSCORED: "without a score in B"}

# Costs are better lower, too; all others are better higher.
_LOWER_IS_BETTER = {
    *("unknown", "depth_disagreement", "frames_dropped", "frames_refused", "frames_labels_refused", "ece"),
    *("frames_without_depth", "frames_left_out", "frames_excluded_from_scores", "frames_excluded", "frames_damaged"),
    *("unlabelled", "held_out_loss"),
}


@dataclass(frozen=True, slots=True)
class Estimate:
    """A difference B - A, its standard error with degrees of freedom, and the ends of its interval."""

    difference: float
    error: float
    freedom: int
    low: float
    high: float

    @classmethod
    def of(cls, difference: float, error: float, freedom: int) -> Estimate:
        """With its interval."""
        reach = float(t.ppf(0.5 + _CONFIDENCE / 2, freedom)) * error
        return cls(difference, error, freedom, difference - reach, difference + reach)

    def p_below(self, limit: float, sign: float) -> float:
        """One-sided p-value of "``sign`` times the true difference is not below ``limit``"."""
        distance = sign * self.difference - limit
        if self.error == 0:
            return 0.0 if distance < 0 else 1.0
        return float(t.cdf(distance / self.error, self.freedom))


@dataclass(frozen=True, slots=True)
class LogChange:
    """One log in both results, or the mean over all with a score in both."""

    log: str  # its URL in A
    # a, b: The metric; None = no score.
    a: float | None
    b: float | None = None
    estimate: Estimate | None = None  # none where its noise is unknown
    status: str = SAME  # "worse", "better", "same"; "failed", "missing", "unscored": has a score in A only
    reason: str = ""  # why it failed


@dataclass(frozen=True, slots=True)
class FleetComparison:
    """All that ``compare_stores`` found."""

    # operation, metric, lower_is_better: What was compared.
    operation: str
    metric: str
    lower_is_better: bool
    mean: LogChange  # over logs
    logs: tuple[LogChange, ...]  # the worst first
    reasons: tuple[str, ...]  # why B is worse; empty = it is not

    def count(self, status: str) -> int:
        """How many logs have a status."""
        return sum(log.status == status for log in self.logs)


def compare_stores(
    store_a: Store,
    store_b: Store,
    operation: str = "",
    metric: str = "miou",
    *,
    threshold: float = 0.0,
    log_threshold: float = 0.02,
    lower_is_better: bool | None = None,
) -> FleetComparison:
    """Compare the latest results of the same logs, paired by the content of these.

    Logs of A that failed in B, or are missing there, count as worse, also where B has no result at all.

    Args:
        store_a: With the results before.
        store_b: With those after.
        operation: Empty = the only one that A has.
        metric: "miou", "miou METHOD", "iou:CLASS", another metric of the results, or a cost.
        threshold: B is worse where the interval of its mean lies below minus this, in units of the metric.
        log_threshold: A log is worse where it is sure to have lost more than this.
        lower_is_better: None = as is known of the metric.

    Raises:
        ConfigError: there is nothing to compare: no such operation or metric, or B has results of other logs only.
        StoreError: a store cannot be reached.
    """
    operation = operation or _only_operation(store_a)
    a, b = (_read_scores(store, operation, metric) for store in (store_a, store_b))
    if not a.logs:
        raise ConfigError(f"{store_a.shown}: has no results of `{operation}`; `fleet run {operation}` makes them")
    if b.logs and a.logs.keys().isdisjoint(b.logs):
        raise ConfigError(f"{store_a.shown} and {store_b.shown}: no log has results of `{operation}` in both")
    if metric not in a.names:
        raise ConfigError(
            f"{store_a.shown}: no result has a value of the metric {metric!r}; there are: "
            f"{', '.join(sorted(a.names)) or 'no metrics'}"
        )
    if lower_is_better is None:
        lower_is_better = metric in _LOWER_IS_BETTER or metric in a.costs
    sign = -1.0 if lower_is_better else 1.0
    errors = {failure.log: failure.error for failure in store_b.failures() if failure.operation == operation}
    changes = [
        _change(log, b.logs.get(digest), errors)
        for digest, log in a.logs.items()
        if log.value is not None or digest not in b.logs
    ]
    mean = _mean(changes)
    changes = sorted(_judged(changes, log_threshold, sign), key=lambda change: _rank(change, sign))
    reasons: list[str] = []
    if mean.estimate is not None and max(sign * mean.estimate.low, sign * mean.estimate.high) < -threshold:
        limit = f" by more than {threshold:g}" if threshold else ""
        reasons.append(f"the mean of {metric} over logs is worse{limit}")
    for status, text in {**_BAD, WORSE: f"lost more than {log_threshold:g}"}.items():
        if count := sum(change.status == status for change in changes):
            reasons.append(f"{counted(count, 'log')} {text}")
    return FleetComparison(operation, metric, lower_is_better, mean, tuple(changes), tuple(reasons))


# One store


@dataclass(frozen=True, slots=True, eq=False)
class _Score:
    """The metric of a result, and (S, 3, L) the stretches that it is computed from; frames and classes of these."""

    url: str
    finished_ns: int
    value: float | None
    stretches: Float64 | None = None
    of: object = None


@dataclass(frozen=True, slots=True)
class _Scores:
    """The latest of each log, by the digest of its content; names of all metrics and costs that have a value."""

    logs: dict[str, _Score] = field(default_factory=dict[str, _Score])
    names: set[str] = field(default_factory=set[str])
    costs: set[str] = field(default_factory=set[str])


def _only_operation(store: Store) -> str:
    found = sorted({result.operation for result in store.results()})
    if len(found) == 1:
        return found[0]
    raise ConfigError(f"{store.shown}: say which operation is meant (--operation): {', '.join(found) or 'it has none'}")


def _read_scores(store: Store, operation: str, metric: str) -> _Scores:
    scores = _Scores()
    for result in store.results():
        if result.operation != operation:
            continue
        costs = {"seconds": result.seconds, **result.findings.costs}
        values = {**costs, **result.findings.metrics}
        values |= {f"iou:{name}": iou for first in result.findings.scores[:1] for name, iou in first.iou.items()}
        scores.names.update(name for name, value in values.items() if value is not None)
        scores.costs.update(costs)
        earlier = scores.logs.get(result.log_digest)
        if earlier is None or result.finished_ns > earlier.finished_ns:
            scores.logs[result.log_digest] = _score(result, metric, values.get(metric))
    return scores


def _score(result: TaskResult, metric: str, value: float | None) -> _Score:
    """With the stretches of the first method, or of the one that the metric names."""
    found = _Score(result.log, result.finished_ns, value)
    of_class = metric.removeprefix("iou:") if metric.startswith("iou:") else None
    for number, scores in enumerate(result.findings.scores):
        is_meant = number == 0 if metric == "miou" or of_class is not None else metric == f"miou {scores.method}"
        if is_meant and value is not None and len(scores.stretches) > 1:
            chosen = np.array([of_class is None or name == of_class for name in scores.names])
            stretches = np.array(scores.stretches, np.float64)[:, :, chosen]
            return replace(found, stretches=stretches, of=(scores.first, scores.names))
    return found


# Changes


def _change(a: _Score, b: _Score | None, errors: dict[str, str]) -> LogChange:
    """Whether a log with a score in both is worse is left open."""
    if b is None:
        status = FAILED if a.url in errors else MISSING
        return LogChange(a.url, a.value, status=status, reason=errors.get(a.url, ""))
    if b.value is None:
        return LogChange(a.url, a.value, status=UNSCORED)
    estimate = None
    if a.stretches is not None and b.stretches is not None and a.of == b.of:
        estimate = _bootstrapped(a.stretches, b.stretches)
    return LogChange(a.url, a.value, b.value, estimate)


def _bootstrapped(a: Float64, b: Float64) -> Estimate | None:
    """Of the stretches (S, 3, L) of a log in both results."""
    count = len(a)
    times = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _RESAMPLES)  # (B, S) how often each
    drawn = _difference(a, b, times.astype(np.float64))
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) < _RESAMPLES // 2:
        return None  # the class is in so few stretches that most draws lack it
    observed = float(_difference(a, b, np.ones((1, count)))[0])
    return Estimate.of(observed, float(drawn.std()) * math.sqrt(count / (count - 1)), count - 1)


def _difference(a: Float64, b: Float64, times: Float64) -> Float64:
    before, after = (miou_of_sums(np.einsum("bs,skl->bkl", times, sums)) for sums in (a, b))
    return after - before


def _judged(changes: Sequence[LogChange], threshold: float, sign: float) -> Iterator[LogChange]:
    """With those that are surely worse or better by more than the threshold."""
    known = {number: change.estimate for number, change in enumerate(changes) if change.estimate is not None}
    status: dict[int, str] = {}
    for name, direction in ((WORSE, sign), (BETTER, -sign)):
        p_values = [estimate.p_below(-threshold, direction) for estimate in known.values()]
        sure = false_discovery_control(p_values) <= (1 - _CONFIDENCE) / 2 if known else []
        status |= {number: name for number, is_sure in zip(known, sure, strict=True) if is_sure}
    for number, change in enumerate(changes):
        yield replace(change, status=status.get(number, change.status))


def _mean(changes: Sequence[LogChange]) -> LogChange:
    both = [change for change in changes if change.b is not None]
    if not both:
        return LogChange("mean over logs", None)
    a, b = np.array([(change.a, change.b) for change in both], np.float64).T
    estimate = both[0].estimate
    if len(both) > 1:
        error = float((b - a).std(ddof=1)) / math.sqrt(len(both))
        estimate = Estimate.of(float((b - a).mean()), error, len(both) - 1)
    return LogChange("mean over logs", float(a.mean()), float(b.mean()), estimate)


def _rank(change: LogChange, sign: float) -> tuple[int, float, str]:
    order = (*_BAD, WORSE)
    gain = sign * (change.b - change.a) if change.a is not None and change.b is not None else 0.0
    return order.index(change.status) if change.status in order else len(order), gain, change.log
