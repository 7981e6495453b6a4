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
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import bootstrap, false_discovery_control, t

from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.metrics import miou_of_sums
from semantic_mapper.nodes.fleet.store import Failure, Store, TaskResult
from semantic_mapper.plain_text import counted
from semantic_mapper.types import Float64

RESAMPLES = 1000
CONFIDENCE = 0.95  # of intervals; a fleet that is no worse is called worse in at most one of twenty comparisons

WORSE, BETTER, SAME = "worse", "better", "same"
FAILED, MISSING, UNSCORED = "failed", "missing", "unscored"
_BAD = (FAILED, MISSING, UNSCORED, WORSE)

# Costs are better lower. Of other metrics, such as the size of a map, nobody can say in general.
HIGHER_IS_BETTER = {
    *("miou", "map_miou", "total_accuracy", "average_accuracy", "coverage", "frames_fused", "frames_scored"),
    *("labelled", "depth_written", "mean_confidence", "labelled_pixels", "held_out_accuracy", "psnr"),
}
LOWER_IS_BETTER = {
    *("unknown", "depth_disagreement", "frames_dropped", "frames_refused", "frames_labels_refused", "ece"),
    *("frames_without_depth", "frames_left_out", "frames_excluded_from_scores", "frames_excluded", "frames_damaged"),
    *("unlabelled", "held_out_loss"),
}


@dataclass(frozen=True, slots=True)
class GateOptions:
    """What is compared, and what counts as worse.

    Args:
        operation: Empty = the only one that both stores have.
        metric: "miou", "miou METHOD", "iou:CLASS", another metric of the results, or a cost.
        threshold: B is worse where the interval of its mean lies below minus this, in units of the metric.
        log_threshold: A log is worse where it is sure to have lost more than this.
        lower_is_better: None = as declared for the metric.
    """

    operation: str = ""
    metric: str = "miou"
    threshold: float = 0.0
    log_threshold: float = 0.02
    lower_is_better: bool | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """A difference B - A, its standard error with degrees of freedom, and the ends of its interval."""

    difference: float
    error: float
    freedom: int
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class LogChange:
    """One log in both results.

    Args:
        log: Its URL in A.
        status: "worse", "better", "same"; "failed", "missing", "unscored": has a score in A only.
        a, b: The metric; None = no score.
        estimate: None where its noise is unknown.
        reason: Why it failed.
    """

    log: str
    status: str
    a: float | None
    b: float | None = None
    estimate: Estimate | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class FleetComparison:
    """All that ``compare_stores`` found.

    Args:
        operation, metric, lower_is_better: What was compared.
        overall: Mean over logs; None where its noise is unknown.
        mean_a, mean_b: Over logs with a score in both; None for none.
        logs: The worst first.
        new: URLs of logs that only B has.
        notes: What a reader has to know.
        reasons: Why B is worse; empty = it is not.
    """

    operation: str
    metric: str
    lower_is_better: bool
    overall: Estimate | None
    mean_a: float | None
    mean_b: float | None
    logs: tuple[LogChange, ...]
    new: tuple[str, ...]
    notes: tuple[str, ...]
    reasons: tuple[str, ...]

    def count(self, status: str) -> int:
        """How many logs have a status."""
        return sum(log.status == status for log in self.logs)


def compare_stores(store_a: Store, store_b: Store, options: GateOptions) -> FleetComparison:
    """Compare the latest results of the same logs, paired by the content of these.

    Logs of A that failed in B, or are missing there, count as worse, also where B has no result at all.

    Args:
        store_a: With the results before.
        store_b: With those after.
        options: What is compared, and what counts as worse.

    Raises:
        ConfigError: there is nothing to compare: no such operation or metric, or B has results of other logs only; or
            it is not known whether more or less of the metric is better.
        StoreError: a store cannot be reached.
    """
    failures = list(store_b.failures())
    operation = options.operation or _only_operation(store_a, store_b, failures)
    a, b = (_read_side(store, operation, options.metric) for store in (store_a, store_b))
    if not a.logs:
        raise ConfigError(f"{store_a.shown}: has no results of `{operation}`; `fleet run {operation}` makes them")
    shared = [digest for digest in a.logs if digest in b.logs]
    if not shared and b.logs:
        raise ConfigError(f"{store_a.shown} and {store_b.shown}: no log has results of `{operation}` in both")
    if options.metric not in a.names:
        raise ConfigError(
            f"{store_a.shown}: no result has a value of the metric {options.metric!r}; there are: "
            f"{', '.join(sorted(a.names)) or 'no metrics'}"
        )
    lower = _is_lower_better(options.metric, a.costs) if options.lower_is_better is None else options.lower_is_better
    sign = -1.0 if lower else 1.0
    changes = [_change(a.logs[digest], b.logs[digest]) for digest in shared if a.logs[digest].value is not None]
    changes = list(_judged(changes, options.log_threshold, sign))
    errors = {failure.log: failure.error for failure in failures if failure.operation == operation}
    for digest, log in a.logs.items():
        if digest not in b.logs:
            status = FAILED if log.url in errors else MISSING
            changes.append(LogChange(log.url, status, log.value, reason=errors.get(log.url, "")))
    overall, means = _overall(changes)
    notes = [
        f"{name} has the latest result of each log, of several versions: {', '.join(sorted(side.versions))}"
        for name, side in (("A", a), ("B", b))
        if len(side.versions) > 1
    ]
    if unknown := sum(change.estimate is None and change.b is not None for change in changes):
        notes.append(f"{counted(unknown, 'log')} without the same stretches in both: judged together only")
    return FleetComparison(
        operation,
        options.metric,
        lower,
        overall,
        *means,
        tuple(sorted(changes, key=lambda change: _rank(change, sign))),
        tuple(sorted(log.url for digest, log in b.logs.items() if digest not in a.logs)),
        tuple(notes),
        tuple(_reasons(changes, overall, options, sign)),
    )


# One store


@dataclass(frozen=True, slots=True, eq=False)
class _Log:
    """The metric of a result, and (S, 3, L) the stretches that it is computed from; frames and classes of these."""

    url: str
    finished_ns: int
    value: float | None
    stretches: Float64 | None = None
    of: object = None


@dataclass(frozen=True, slots=True)
class _Side:
    """Logs by the digest of their content; names of metrics and costs that have a value."""

    logs: dict[str, _Log] = field(default_factory=dict[str, _Log])
    names: set[str] = field(default_factory=set[str])
    costs: set[str] = field(default_factory=set[str])
    versions: set[str] = field(default_factory=set[str])


def _only_operation(store_a: Store, store_b: Store, failures_b: Sequence[Failure]) -> str:
    """Where B has nothing at all, that of A: all of its logs are missing in B."""
    there = {result.operation for result in store_b.results()} | {failure.operation for failure in failures_b}
    both = sorted({result.operation for result in store_a.results() if result.operation in there or not there})
    if len(both) == 1:
        return both[0]
    found = ", ".join(both) if both else "none in both"
    raise ConfigError(f"{store_a.shown} and {store_b.shown}: say which operation is meant (--operation): {found}")


def _read_side(store: Store, operation: str, metric: str) -> _Side:
    side = _Side()
    for result in store.results():
        if result.operation != operation:
            continue
        first = result.findings.scores[:1]
        costs = {"seconds": result.seconds, **result.findings.costs}
        values = {**costs, **result.findings.metrics}
        values |= {f"iou:{name}": iou for scores in first for name, iou in scores.iou.items()}
        side.names.update(name for name, value in values.items() if value is not None)
        side.costs.update(costs)
        side.versions.add(result.version)
        earlier = side.logs.get(result.log_digest)
        if earlier is None or result.finished_ns > earlier.finished_ns:
            side.logs[result.log_digest] = _log_of(result, metric, values.get(metric))
    return side


def _log_of(result: TaskResult, metric: str, value: float | None) -> _Log:
    """With the stretches of the first method, or of the one that the metric names."""
    log = _Log(result.log, result.finished_ns, value)
    of_class = metric.removeprefix("iou:") if metric.startswith("iou:") else None
    for number, scores in enumerate(result.findings.scores):
        is_meant = number == 0 if metric == "miou" or of_class is not None else metric == f"miou {scores.method}"
        if is_meant and value is not None and len(scores.stretches) > 1:
            chosen = np.array([of_class is None or name == of_class for name in scores.names])
            stretches = np.array(scores.stretches, np.float64)[:, :, chosen]
            return replace(log, stretches=stretches, of=(scores.first, scores.names))
    return log


# One log


def _change(first: _Log, second: _Log) -> LogChange:
    """The status of logs with a score in both is left open."""
    if second.value is None:
        return LogChange(first.url, UNSCORED, first.value)
    if first.stretches is None or second.stretches is None or first.of != second.of:
        return LogChange(first.url, SAME, first.value, second.value)
    return LogChange(first.url, SAME, first.value, second.value, _bootstrapped(first.stretches, second.stretches))


def _bootstrapped(a: Float64, b: Float64) -> Estimate | None:
    """Of the stretches (S, 3, L) of a log in both results."""

    def difference(rows: Float64, axis: int = -1) -> Float64:  # (B, S) numbers of stretches -> (B,)
        drawn = rows.astype(np.int64)
        return miou_of_sums(b[drawn].sum(axis=1)) - miou_of_sums(a[drawn].sum(axis=1))

    count = len(a)
    rows = np.arange(count)[None].astype(np.float64)
    rng = np.random.default_rng(0)
    found = bootstrap(rows, difference, n_resamples=RESAMPLES, batch=RESAMPLES, method="percentile", rng=rng)
    drawn = found.bootstrap_distribution[np.isfinite(found.bootstrap_distribution)]
    if len(drawn) < RESAMPLES // 2:
        return None  # the class is in so few stretches that most draws lack it
    return _estimate(float(difference(rows)[0]), float(drawn.std()) * math.sqrt(count / (count - 1)), count - 1)


def _estimate(difference: float, error: float, freedom: int) -> Estimate:
    reach = float(t.ppf(0.5 + CONFIDENCE / 2, freedom)) * error
    return Estimate(difference, error, freedom, difference - reach, difference + reach)


# All logs


def _judged(changes: Sequence[LogChange], threshold: float, sign: float) -> Iterator[LogChange]:
    """Logs that are surely worse or better by more than the threshold."""
    known = [(number, change.estimate) for number, change in enumerate(changes) if change.estimate is not None]
    status: dict[int, str] = {}
    for name, direction in ((WORSE, sign), (BETTER, -sign)):
        p_values = [_p_below(estimate, -threshold, direction) for _, estimate in known]
        sure = false_discovery_control(p_values) <= (1 - CONFIDENCE) / 2 if known else []
        status |= {number: name for (number, _), is_sure in zip(known, sure, strict=True) if is_sure}
    for number, change in enumerate(changes):
        yield replace(change, status=status.get(number, change.status))


def _p_below(estimate: Estimate, limit: float, sign: float) -> float:
    """One-sided p-value of "``sign`` times the true difference is not below ``limit``"."""
    distance = sign * estimate.difference - limit
    if estimate.error == 0:
        return 0.0 if distance < 0 else 1.0
    return float(t.cdf(distance / estimate.error, estimate.freedom))


def _overall(changes: Sequence[LogChange]) -> tuple[Estimate | None, tuple[float | None, float | None]]:
    """The mean difference over logs, and the means of A and B."""
    both = [change for change in changes if change.a is not None and change.b is not None]
    if not both:
        return None, (None, None)
    a, b = np.array([(change.a, change.b) for change in both], np.float64).T
    means = float(a.mean()), float(b.mean())
    if len(both) == 1:
        return both[0].estimate, means
    error = float((b - a).std(ddof=1)) / math.sqrt(len(both))
    return _estimate(means[1] - means[0], error, len(both) - 1), means


def _is_lower_better(metric: str, costs: set[str]) -> bool:
    if metric in HIGHER_IS_BETTER or metric.startswith(("iou:", "miou ")):
        return False
    if metric in LOWER_IS_BETTER or metric in costs:
        return True
    raise ConfigError(
        f"{metric}: it is not known whether more or less of this metric is better; say --higher-is-better or "
        "--lower-is-better"
    )


def _rank(change: LogChange, sign: float) -> tuple[int, float, str]:
    gain = sign * (change.b - change.a) if change.a is not None and change.b is not None else 0.0
    return _BAD.index(change.status) if change.status in _BAD else len(_BAD), gain, change.log


def _reasons(
    changes: Sequence[LogChange], overall: Estimate | None, options: GateOptions, sign: float
) -> Iterator[str]:
    if overall is not None and max(sign * overall.low, sign * overall.high) < -options.threshold:
        limit = f" by more than {options.threshold:g}" if options.threshold else ""
        yield f"the mean of {options.metric} over logs is worse{limit}"
    counts: Mapping[str, int] = Counter(change.status for change in changes)
    texts = ("failed in B", "missing in B", "without a score in B", f"lost more than {options.log_threshold:g}")
    for status, text in zip(_BAD, texts, strict=True):
        if counts[status]:
            yield f"{counted(counts[status], 'log')} {text}"
