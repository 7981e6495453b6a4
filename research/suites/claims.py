"""Claims of a paper as relative checks: the difference of two figures, its interval, and the result.

Confusion matrices are kept by *unit*: a scene or view, in a group of such. A bootstrap draws units, each group's among
themselves; both sides of a claim get the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from research.evaluation.bootstrap import miou_of_counts
from semantic_mapper.types import Float64

RESAMPLES = 2000

Result = Literal["accepted", "refused", "not judged", "not run"]

Unit = tuple[int, int]  # group and number: what a bootstrap draws
Counts = NDArray[np.int64]  # (L, L + 1) of a confusion matrix, or (1, 2) agreeing and compared pixels
CountTable = Mapping[tuple[str, str], Mapping[Unit, Counts]]  # by arm and by what is scored

_Draws = Mapping[Unit, Float64]  # how often each unit was drawn, (B,)


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of an arm, in points.

    Args:
        name: As text.
        kinds: What has to be scored for it.
        value: (B,) from the summed counts (B, L, L + 1) of each kind.
    """

    name: str
    kinds: tuple[str, ...]
    value: Callable[[Sequence[Float64]], Float64]


def miou_measure(name: str, kind: str) -> Measure:
    """mIoU of one kind."""
    return Measure(name, (kind,), lambda counts: 100 * miou_of_counts(counts[0]))


@dataclass(frozen=True, slots=True)
class Claim:
    """``measure`` of ``first`` minus ``factor`` times that of ``second`` lies between ``least`` and ``most``.

    Args:
        name: What is claimed.
        paper: Its figures, as text; empty for a check of the suite itself.
        measure: Figure.
        first: Arm.
        second: Arm; None = 0.
        second_measure: Figure of ``second``; None = ``measure``.
        least, most: Bounds in points. A bound of 0 or above from below is a gain: its interval must lie above 0, too.
        factor: Of ``second``.
        at_plateau: Arms whose steps the claim is about: it is judged only where they are at their plateau.
        same_steps: Judge it only where both arms were trained for the same steps.
    """

    name: str
    paper: str
    measure: Measure
    first: str
    second: str | None = None
    second_measure: Measure | None = None
    least: float = -np.inf
    most: float = np.inf
    factor: float = 1.0
    at_plateau: tuple[str, ...] = ()
    same_steps: bool = False

    @property
    def arms(self) -> tuple[str, ...]:
        """Whose figures it needs."""
        return (self.first,) if self.second is None else (self.first, self.second)

    @property
    def accepted_if(self) -> str:
        """The bounds as text."""
        if np.isinf(self.least):
            return f"<= {self.most:g}"
        if np.isinf(self.most):
            return "> 0" if self.least == 0 else f">= {self.least:g}"
        return f"{self.least:g} to {self.most:g}"


class Training(NamedTuple):
    """How arms were trained: those that are not at their plateau, and the steps of each (by seed)."""

    unfinished: Collection[str] = ()
    steps: Mapping[str, Collection[int]] = MappingProxyType({})


_NOT_SAID = Training()


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """What came of a claim; figures in points, None where it was not run."""

    claim: Claim
    result: Result
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    units: int = 0
    reason: str = ""  # why it is not judged


def figure(table: CountTable, arm: str, measure: Measure) -> float | None:
    """A figure of an arm in points; None where it was not scored."""
    kinds = [table.get((arm, kind)) for kind in measure.kinds]
    if any(not units for units in kinds):
        return None
    return float(measure.value([_sum(units, None) for units in kinds if units])[0])


def check_claim(claim: Claim, table: CountTable, *, training: Training = _NOT_SAID, seed: int = 0) -> ClaimResult:
    """Judge a claim by the units that both sides have been scored on, with a 95 % bootstrap interval over them.

    Args:
        claim: What to judge.
        table: Counts by arm, by what is scored, and by unit.
        training: Of the arms.
        seed: Of the bootstrap.
    """
    measures = (claim.measure, claim.second_measure or claim.measure)
    sides = list(zip(claim.arms, measures, (1.0, -claim.factor), strict=False))  # the second may be missing
    shared = [
        sorted(set.intersection(*(set(table.get((arm, measure.kinds[k]), {})) for arm, measure, _ in sides)))
        for k in range(len(claim.measure.kinds))
    ]
    count = min(map(len, shared))
    if count < 2:
        return ClaimResult(claim, "not run", units=count)
    draws = [_draws(units, np.random.default_rng((seed, k))) for k, units in enumerate(shared)]
    observed, drawn = np.zeros(1), np.zeros(RESAMPLES)
    for arm, measure, sign in sides:
        counts = [{u: table[arm, kind][u] for u in units} for kind, units in zip(measure.kinds, shared, strict=True)]
        observed = observed + sign * measure.value([_sum(c, None) for c in counts])
        drawn = drawn + sign * measure.value([_sum(c, d) for c, d in zip(counts, draws, strict=True)])
    low, high = (float(x) for x in np.nanpercentile(drawn, (2.5, 97.5)))
    difference = float(observed[0])
    right = claim.least <= difference <= claim.most and not (claim.least >= 0 >= low)
    reason = _not_judged(claim, training)
    result: Result = "not judged" if reason else "accepted" if right else "refused"
    return ClaimResult(claim, result, difference, low, high, count, reason)


def check_claims(
    claims: Sequence[Claim], table: CountTable, *, training: Training = _NOT_SAID, seed: int = 0
) -> list[ClaimResult]:
    """``check_claim`` of each."""
    return [check_claim(claim, table, training=training, seed=seed) for claim in claims]


def _not_judged(claim: Claim, training: Training) -> str:
    """Why a claim is not judged; empty where it is."""
    if unfinished := [arm for arm in claim.at_plateau if arm in training.unfinished]:
        return f"{', '.join(unfinished)} not at the plateau"
    steps = {arm: sorted(training.steps.get(arm, ())) for arm in claim.arms}
    if claim.same_steps and len({*map(tuple, steps.values())}) > 1:
        return ", ".join(f"{arm} {'/'.join(map(str, found))} steps" for arm, found in steps.items())
    return ""


def _draws(units: Sequence[Unit], rng: np.random.Generator) -> dict[Unit, Float64]:
    """How often each unit is drawn (RESAMPLES,), each group's among themselves."""
    found: dict[Unit, Float64] = {}
    for group in sorted({group for group, _ in units}):
        own = [unit for unit in units if unit[0] == group]
        times = rng.multinomial(len(own), np.full(len(own), 1 / len(own)), size=RESAMPLES).astype(np.float64)
        found |= dict(zip(own, times.T, strict=True))
    return found


def _sum(counts: Mapping[Unit, Counts], draws: _Draws | None) -> Float64:
    """(B, L, L + 1) counts of all units, as often as each was drawn; B = 1 without draws."""
    stack: NDArray[np.float64] = np.stack([counts[unit] for unit in counts]).astype(np.float64)
    times = np.ones((1, len(counts))) if draws is None else np.stack([draws[unit] for unit in counts], axis=1)
    return np.einsum("bs,slc->blc", times, stack, optimize=True)
