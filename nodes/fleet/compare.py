"""Which logs got better or worse from one set of results to another, beyond noise.

Noise of a log: a paired block bootstrap. Stretches of consecutive frames are drawn with replacement, the same ones for
both results, and their confusion matrices added (Künsch 1989; Efron and Tibshirani 1993). The spread of the difference
over the draws is its standard error; intervals and p-values are Student's with one degree of freedom less than there
are stretches. Percentiles of the draws would be too narrow for a dozen stretches, and know no p-value below one in the
number of draws, which a fleet of thousands of logs needs.

Noise of the fleet: the same over logs. The bootstrap's standard error of a mean has a closed form, which is used.

Many logs: Benjamini-Hochberg. Where no log is worse, it names one as rarely as Bonferroni-Holm does, which is what a
gate has to promise; where some are, it finds more of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np

from semantic_mapper.errors import ConfigError
from semantic_mapper.evaluation.bootstrap import class_sums, miou_of_sums
from semantic_mapper.nodes.fleet.metrics import CLASS_PREFIX, METHOD_PREFIX, Direction, is_lower_better
from semantic_mapper.nodes.fleet.results import Failure, SegmentRow, TaskResult
from semantic_mapper.nodes.fleet.store import Store, batched
from semantic_mapper.nodes.fleet.tables import Tables
from semantic_mapper.nodes.fleet.variants import Variant, choose_variant, failed_variant, operations, variants
from semantic_mapper.plain_text import counted
from semantic_mapper.types import Float64

RESAMPLES = 1000
CONFIDENCE = 0.95  # of intervals; a fleet that is no worse is called worse in at most one of twenty comparisons
_PAIRS_AT_ONCE = 64  # results of each side that are in memory

WORSE, BETTER, SAME = "worse", "better", "same"
FAILED, MISSING, UNSCORED = "failed", "missing", "unscored"


@dataclass(frozen=True, slots=True)
class GateOptions:
    """What is compared, and what counts as worse.

    Args:
        operation: Empty = the only one that both stores have.
        metric: "miou", "iou:CLASS", or another metric of the results.
        method: Whose labels count in "miou" and "iou:CLASS"; empty = that of the metric "miou" in A.
        a, b: Names and values that choose results: version, weights, code, or a setting. Of several, the latest count.
        threshold: The fleet is worse where the interval of its mean lies below minus this, in units of the metric.
        log_threshold: A log is worse where it is sure to have lost more than this.
        lower_is_better: None = as declared for the metric.
        costs: Allowed rise of a cost, as a fraction of it, by name.
    """

    operation: str = ""
    metric: str = "miou"
    method: str = ""
    a: Mapping[str, str] = field(default_factory=dict)
    b: Mapping[str, str] = field(default_factory=dict)
    threshold: float = 0.0
    log_threshold: float = 0.02
    lower_is_better: bool | None = None
    costs: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A difference B - A with its noise.

    Args:
        difference: As observed.
        error: Its standard error.
        freedom: Degrees of freedom of ``error``.
        low, high: Ends of its interval.
    """

    difference: float
    error: float
    freedom: int
    low: float
    high: float

    def p_below(self, limit: float) -> float:
        """One-sided p-value of "the true difference is not below ``limit``"."""
        from scipy.stats import t

        if self.error == 0:
            return 0.0 if self.difference < limit else 1.0
        return float(t.cdf((self.difference - limit) / self.error, self.freedom))


@dataclass(frozen=True, slots=True)
class LogChange:
    """One log in both results.

    Args:
        log: Its URL in A.
        log_digest: Of its content.
        status: "worse", "better", "same"; "failed", "missing", "unscored": has a score in A only.
        a, b: The metric; None = no score.
        estimate: None where its noise is unknown.
        reason: Why it failed.
        key_a, key_b: Of the results; empty = no result.
    """

    log: str
    log_digest: str
    status: str
    a: float | None
    b: float | None
    estimate: Estimate | None = None
    reason: str = ""
    key_a: str = ""
    key_b: str = ""


@dataclass(frozen=True, slots=True)
class CostChange:
    """How a cost changed over the logs that have it in both results.

    Args:
        name: "seconds", or a name of ``Findings.costs``.
        a, b: Medians over logs.
        ratio: Geometric mean of B / A over logs, with the interval ``low``..``high``, NaN for a single log.
        logs: How many.
        limit: Allowed rise as a fraction; None = any.
        exceeded: The interval lies above it.
    """

    name: str
    a: float
    b: float
    ratio: float
    low: float
    high: float
    logs: int
    limit: float | None
    exceeded: bool


@dataclass(frozen=True, slots=True)
class FleetComparison:
    """All that ``compare_fleets`` found.

    Args:
        operation, metric: What was compared.
        a, b: In words, which results.
        lower_is_better: Of the metric.
        overall: Mean over logs; None where noise is unknown.
        mean_a, mean_b: Over logs with a score in both; NaN for none.
        logs: The worst first.
        new: URLs of logs that only B has.
        costs: By name.
        notes: What a reader has to know.
        reasons: Why B is worse; empty = it is not.
    """

    operation: str
    metric: str
    a: str
    b: str
    lower_is_better: bool
    overall: Estimate | None
    mean_a: float
    mean_b: float
    logs: tuple[LogChange, ...]
    new: tuple[str, ...]
    costs: tuple[CostChange, ...]
    notes: tuple[str, ...]
    reasons: tuple[str, ...]

    @property
    def direction(self) -> Direction:
        """What is better."""
        return Direction.LOWER if self.lower_is_better else Direction.HIGHER

    @property
    def worse(self) -> bool:
        """Whether a release should stop."""
        return bool(self.reasons)

    def count(self, status: str) -> int:
        """How many logs have a status."""
        return sum(log.status == status for log in self.logs)

    def to_plain(self) -> dict[str, Any]:
        """For JSON: NaN as None."""
        return {"worse": self.worse, "direction": self.direction.value, **_finite(msgspec.to_builtins(self))}


def compare_fleets(store_a: Store, store_b: Store, options: GateOptions) -> FleetComparison:
    """Compare results of the same logs; a bounded number of them is in memory.

    Logs of A that failed in B, or are missing there, count as worse, also where B has no result at all.

    Args:
        store_a: With the results before.
        store_b: With those after; may be the same store.
        options: What is compared, and what counts as worse.

    Raises:
        ConfigError: there is nothing to compare: no such operation, version, metric, method or cost, or B has results
            of other logs only, and no failures of those of A.
        FleetError: it is not known whether more or less of the metric is better.
        StoreError: a store cannot be reached.
        DependencyError: DuckDB or pyarrow is missing.
    """
    with Tables(store_a) as tables_a, Tables(store_b) as tables_b:
        failures = sorted(store_b.failures(), key=lambda failure: failure.finished_ns)
        operation = options.operation or _only_operation(tables_a, tables_b, failures)
        failures = [failure for failure in failures if failure.operation == operation]
        a = choose_variant(tables_a, operation, options.a)
        b = _candidate(tables_b, operation, options.b, [f for f in failures if f.log in set(a.logs.values())])
        notes = _partial(tables_a, operation, a, "A") + _partial(tables_b, operation, b, "B")
    shared = [digest for digest in a.keys if digest in b.keys]
    lost = list(_lost(failures, a, b))
    if not shared and b.keys and not any(change.status == FAILED for change in lost):
        raise ConfigError(
            f"{store_a.shown} and {store_b.shown}: no log has results of `{operation}` in both; A has "
            f"{counted(len(a.keys), 'log')} of {a.describe()}, B {counted(len(b.keys), 'log')} of {b.describe()}"
        )
    if store_a.url == store_b.url and a.keys == b.keys:
        notes.append("A and B are the same results")
    return compare_results(
        _pairs(store_a, store_b, a, b, shared),
        options,
        operation=operation,
        a=f"{store_a.shown}: {a.describe()}",
        b=f"{store_b.shown}: {b.describe()}",
        lost=lost,
        new=sorted(b.logs[digest] for digest in b.keys.keys() - a.keys.keys()),
        notes=notes,
    )


def compare_results(
    pairs: Iterable[tuple[TaskResult, TaskResult]],
    options: GateOptions,
    *,
    operation: str = "",
    a: str = "A",
    b: str = "B",
    lost: Sequence[LogChange] = (),
    new: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> FleetComparison:
    """Compare results that belong together.

    Args:
        pairs: Before and after, of the same log.
        options: What is compared, and what counts as worse.
        operation, a, b: For people.
        lost: Logs that have a result in A only; they count as worse.
        new: URLs of logs that have one in B only.
        notes: What is known already.

    Raises:
        ConfigError: no result has the metric, the method, or a cost that ``options`` limits; or there are neither pairs
            nor logs that were lost.
        FleetError: it is not known whether more or less of the metric is better.
    """
    found = Counter(notes)
    paired = False
    metric = _Metric(options)
    changes: list[LogChange] = []
    costs: dict[str, list[tuple[float, float]]] = {}
    for first, second in pairs:
        paired = True
        if (change := metric.change(first, second, found)) is not None:
            changes.append(change)
        for name, pair in _costs(first, second):
            costs.setdefault(name, []).append(pair)
    if paired and options.method and options.method not in metric.methods:
        raise ConfigError(
            f"{a}: no result has the method {options.method!r}; there are: "
            f"{'; '.join(sorted(metric.methods)) or 'no methods'}"
        )
    if not changes and (paired or not lost):
        raise ConfigError(
            f"{a}: no result has a value of the metric {options.metric!r}; there are: "
            f"{', '.join(sorted(metric.others)) or 'no metrics'}"
        )
    lower = is_lower_better(options.metric) if options.lower_is_better is None else options.lower_is_better
    sign = -1.0 if lower else 1.0
    changes = [*_judged(changes, options, sign), *lost]
    overall, means = _overall(changes)
    cost_changes = _cost_changes(costs, options) if paired else ()
    changes.sort(key=lambda change: _rank(change, sign))
    unknown = sum(c.estimate is None for c in changes if c.status in (WORSE, BETTER, SAME))
    if unknown:
        found[f"{counted(unknown, 'log')} without stretches in both: judged together only, not each by itself"] += 1
    if overall is None and means:
        found["one log without stretches: its noise is unknown, so nothing is called worse or better"] += 1
    return FleetComparison(
        operation,
        options.metric,
        a,
        b,
        lower,
        overall,
        means[0] if means else math.nan,
        means[1] if means else math.nan,
        tuple(changes),
        tuple(new),
        cost_changes,
        tuple(note if count == 1 else f"{note} ({counted(count, 'log')})" for note, count in found.items()),
        tuple(_reasons(changes, overall, cost_changes, options, sign)),
    )


def _only_operation(tables_a: Tables, tables_b: Tables, failures_b: Iterable[Failure]) -> str:
    """Where B has nothing at all, that of A: all of its logs are missing in B."""
    there = {*operations(tables_b), *(failure.operation for failure in failures_b)}
    both = [name for name in operations(tables_a) if name in there or not there]
    if len(both) == 1:
        return both[0]
    found = ", ".join(both) if both else "none in both"
    raise ConfigError(
        f"{tables_a.store.shown} and {tables_b.store.shown}: say which operation is meant (--operation): {found}"
    )


def _candidate(tables: Tables, operation: str, wanted: Mapping[str, str], failures: Sequence[Failure]) -> Variant:
    """The variant of B; one without results where all logs failed, or none were done.

    Args:
        tables: Of B.
        operation: Of the variant.
        wanted: What ``--b`` says.
        failures: Of logs of A, in this operation of B, the latest last.
    """
    found = variants(tables, operation)
    if not found:
        return failed_variant(failures[-1].version if failures else "")
    versions = {variant.version for variant in found}
    failed = [failure for failure in failures if failure.version not in versions]
    if wanted:
        failed = [f for f in failed if wanted.keys() == {"version"} and f.version.startswith(wanted["version"])]
        if failed and not any(variant.is_meant(wanted) for variant in found):
            return failed_variant(failed[-1].version)
    elif failed and failed[-1].finished_ns // 1000 > found[0].finished_us:
        return failed_variant(failed[-1].version)  # the latest version has failures only
    return choose_variant(tables, operation, wanted)


def _partial(tables: Tables, operation: str, chosen: Variant, side: str) -> list[str]:
    most = max((len(variant.keys) for variant in variants(tables, operation)), default=0)
    if len(chosen.keys) == most:
        return []
    return [f"{side} has {counted(len(chosen.keys), 'log')} of {chosen.describe()}, and up to {most} of other variants"]


def _pairs(
    store_a: Store, store_b: Store, a: Variant, b: Variant, digests: Sequence[str]
) -> Iterator[tuple[TaskResult, TaskResult]]:
    for batch in batched(digests, _PAIRS_AT_ONCE):
        first = {result.log_digest: result for result in store_a.results(a.keys[digest] for digest in batch)}
        second = {result.log_digest: result for result in store_b.results(b.keys[digest] for digest in batch)}
        for digest in batch:
            if digest in first and digest in second:
                yield first[digest], second[digest]


# One log


class _Metric:
    """Computes the metric of pairs of results.

    Attributes:
        others: Names of metrics of which results in A have a value.
        methods: Names of methods in A.
    """

    def __init__(self, options: GateOptions) -> None:
        self._name, self._method = options.metric, options.method
        self.others: set[str] = set()
        self.methods: set[str] = set()
        if self._method and not self._has_methods():
            raise ConfigError(f"--method {self._method}: {self._name} is no metric of a method; miou and iou:CLASS are")

    def change(self, first: TaskResult, second: TaskResult, notes: Counter[str]) -> LogChange | None:
        """None where A has no score. The status of the rest is left open."""
        found = first.findings
        self.others |= {name for name, value in found.metrics.items() if value is not None}
        self.others |= {f"{CLASS_PREFIX}{row.name}" for row in found.classes if math.isfinite(row.iou)}
        self.methods |= {row.method for row in (*found.classes, *found.segments)}
        sums = self._stretches(first, second, notes)
        if sums is None:
            a, b = self._value(first), self._value(second)
            estimate = None
        else:
            a, b = (float(self._of_sums(side.sum(axis=0, keepdims=True))[0]) for side in sums)
            a, b = (None if math.isnan(value) else value for value in (a, b))
            estimate = None if a is None or b is None else self._estimate(*sums)
        if a is None:
            return None
        status, reason = (UNSCORED, f"has no {self._name} in B") if b is None else (SAME, "")
        return LogChange(first.log, first.log_digest, status, a, b, estimate, reason, first.key, second.key)

    def _has_methods(self) -> bool:
        return self._name == "miou" or self._name.startswith(CLASS_PREFIX)

    def _value(self, result: TaskResult) -> float | None:
        method = self._method or main_method(result)
        if self._name.startswith(CLASS_PREFIX):
            wanted = self._name.removeprefix(CLASS_PREFIX)
            rows = (row for row in result.findings.classes if (row.name, row.method) == (wanted, method))
            return next((row.iou for row in rows), None)
        if self._name == "miou" and method != main_method(result):
            return result.findings.metrics.get(f"{METHOD_PREFIX}{method}")
        return result.findings.metrics.get(self._name)

    def _stretches(self, first: TaskResult, second: TaskResult, notes: Counter[str]) -> tuple[Float64, Float64] | None:
        """(S, 3, L) of the S stretches that both have, by ``class_sums``, classes in the same order; None for < 2."""
        if not self._has_methods():
            return None
        method = self._method or main_method(first)
        a, b = (
            {row.first: row for row in result.findings.segments if row.method == method} for result in (first, second)
        )
        both = sorted(a.keys() & b.keys())
        if len(both) < 2:
            return None
        if len(both) < max(len(a), len(b)):
            notes["some stretches of frames are in one of the results only, and do not count"] += 1
        if any(a[n].frames != b[n].frames for n in both):
            notes["some stretches hold other numbers of frames in A than in B"] += 1
        names = list(dict.fromkeys(name for rows in (a, b) for n in both for name in rows[n].names))
        if {a[both[0]].names} != {b[both[0]].names}:
            notes["names of classes differ; those of the same name are compared"] += 1
        return self._sums([a[n] for n in both], names), self._sums([b[n] for n in both], names)

    def _sums(self, rows: Sequence[SegmentRow], names: Sequence[str]) -> Float64:
        sums = np.zeros((len(rows), 3, len(names)))
        places = {name: place for place, name in enumerate(names)}
        for number, row in enumerate(rows):
            counts = np.array(row.counts, np.float64).reshape(1, len(row.names), -1)
            sums[number][:, [places[name] for name in row.names]] = class_sums(counts)[0]
        wanted = self._name.removeprefix(CLASS_PREFIX)
        if self._name == "miou":
            return sums
        return sums[:, :, [places[wanted]]] if wanted in places else np.zeros((len(rows), 3, 1))

    def _of_sums(self, sums: Float64) -> Float64:
        """(B, 3, L) -> (B,); the IoU of a single class is the mean over one."""
        return miou_of_sums(sums)

    def _estimate(self, a: Float64, b: Float64) -> Estimate | None:
        """Of two (S, 3, L); the draws are the same for every log of S stretches."""
        stretches = len(a)
        rng = np.random.default_rng(0)
        times = rng.multinomial(stretches, np.full(stretches, 1 / stretches), size=RESAMPLES).astype(np.float64)
        drawn = [
            self._of_sums((times @ side.reshape(stretches, -1)).reshape(RESAMPLES, *side.shape[1:])) for side in (b, a)
        ]
        differences = drawn[0] - drawn[1]
        differences = differences[np.isfinite(differences)]
        if len(differences) < RESAMPLES // 2:
            return None  # the class is in so few stretches that most draws lack it
        observed = self._of_sums(b.sum(axis=0, keepdims=True)) - self._of_sums(a.sum(axis=0, keepdims=True))
        error = float(differences.std()) * math.sqrt(stretches / (stretches - 1))
        return _estimate(float(observed[0]), error, stretches - 1)


def main_method(result: TaskResult) -> str:
    """Whose labels the metric "miou" of a result is about; empty where it has no rows of classes or stretches."""
    return next((row.method for row in (*result.findings.segments, *result.findings.classes)), "")


def _estimate(difference: float, error: float, freedom: int) -> Estimate:
    from scipy.stats import t

    reach = float(t.ppf(0.5 + CONFIDENCE / 2, freedom)) * error
    return Estimate(difference, error, freedom, difference - reach, difference + reach)


# All logs


def _judged(changes: Sequence[LogChange], options: GateOptions, sign: float) -> Iterator[LogChange]:
    """Logs that are surely worse or better by more than the threshold."""
    from scipy.stats import false_discovery_control

    known = [(number, c.estimate) for number, c in enumerate(changes) if c.estimate is not None]
    status: dict[int, str] = {}
    for name, direction in ((WORSE, sign), (BETTER, -sign)):
        p_values = [_flipped(e, direction).p_below(-options.log_threshold) for _, e in known]
        sure = false_discovery_control(p_values) <= (1 - CONFIDENCE) / 2 if known else []
        status |= {number: name for (number, _), is_sure in zip(known, sure, strict=True) if is_sure}
    for number, change in enumerate(changes):
        yield replace(change, status=status[number]) if number in status else change


def _flipped(estimate: Estimate, direction: float) -> Estimate:
    """As the difference of a metric of which more is better, where ``direction`` is -1."""
    e = estimate
    return e if direction > 0 else Estimate(-e.difference, e.error, e.freedom, -e.high, -e.low)


def _lost(failures_b: Iterable[Failure], a: Variant, b: Variant) -> Iterator[LogChange]:
    """Logs with a result in A only; of several failures of a log, the last one counts."""
    failures = {failure.log: failure for failure in failures_b}
    for digest in [digest for digest in a.keys if digest not in b.keys]:
        log = a.logs[digest]
        failure = failures.get(log)
        reason = failure.errors[-1] if failure and failure.errors else ""
        yield LogChange(log, digest, FAILED if failure else MISSING, None, None, None, reason, a.keys[digest])


def _overall(changes: Sequence[LogChange]) -> tuple[Estimate | None, tuple[float, float] | None]:
    """The mean difference over logs, and the means of A and B; None where there is nothing or its noise is unknown."""
    scored = [(c.a, c.b) for c in changes if c.a is not None and c.b is not None]
    if not scored:
        return None, None
    a, b = np.array(scored).T
    means = float(a.mean()), float(b.mean())
    if len(scored) == 1:
        return next(c.estimate for c in changes if c.b is not None), means
    differences = b - a
    error = float(differences.std(ddof=1)) / math.sqrt(len(scored))
    return _estimate(float(differences.mean()), error, len(scored) - 1), means


def _costs(first: TaskResult, second: TaskResult) -> Iterator[tuple[str, tuple[float, float]]]:
    a, b = ({"seconds": r.seconds, **r.findings.costs} for r in (first, second))
    for name, before in a.items():
        after = b.get(name)
        if before is not None and after is not None and before > 0 and after > 0:
            yield name, (before, after)


def _cost_changes(costs: Mapping[str, list[tuple[float, float]]], options: GateOptions) -> tuple[CostChange, ...]:
    for name in options.costs:
        if name not in costs:
            raise ConfigError(f"--cost {name}: no log has it in both; there are: {', '.join(costs) or 'no costs'}")
    found = []
    for name, pairs in costs.items():
        a, b = np.array(pairs).T
        logs = len(pairs)
        ratios = np.log(b / a)
        error = float(ratios.std(ddof=1)) / math.sqrt(logs) if logs > 1 else math.nan
        estimate = _estimate(float(ratios.mean()), error, max(logs - 1, 1))
        low, high = math.exp(estimate.low), math.exp(estimate.high)
        limit = options.costs.get(name)
        exceeded = limit is not None and low > 1 + limit  # never for NaN
        ratio = math.exp(estimate.difference)
        found.append(
            CostChange(name, float(np.median(a)), float(np.median(b)), ratio, low, high, logs, limit, exceeded)
        )
    return tuple(found)


def _rank(change: LogChange, sign: float) -> tuple[int, float, str]:
    statuses = (FAILED, MISSING, UNSCORED, WORSE, SAME, BETTER)
    gain = sign * (change.b - change.a) if change.a is not None and change.b is not None else 0.0
    return min(statuses.index(change.status), statuses.index(WORSE)), gain, change.log


def _reasons(
    changes: Sequence[LogChange],
    overall: Estimate | None,
    costs: Sequence[CostChange],
    options: GateOptions,
    sign: float,
) -> Iterator[str]:
    if overall is not None and _flipped(overall, sign).high < -options.threshold:
        limit = f" by more than {options.threshold:g}" if options.threshold else ""
        yield f"the mean of {options.metric} over logs is worse{limit}"
    counts = Counter(change.status for change in changes)
    for status, text in (
        (WORSE, f"lost more than {options.log_threshold:g}"),
        (FAILED, "failed in B"),
        (MISSING, "missing in B"),
        (UNSCORED, "without a score in B"),
    ):
        if counts[status]:
            yield f"{counted(counts[status], 'log')} {text}"
    for cost in costs:
        if cost.exceeded:
            yield f"{cost.name} rose by {100 * (cost.ratio - 1):.1f} %, allowed are {100 * (cost.limit or 0):g} %"


def _finite(data: Any) -> Any:
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {name: _finite(value) for name, value in data.items()}
    return [_finite(item) for item in data] if isinstance(data, (list, tuple)) else data
