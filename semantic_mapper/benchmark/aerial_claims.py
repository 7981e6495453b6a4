"""The claims of IRT as checks on AERIAL: figures of arms, their differences, and 95 % bootstrap intervals.

A bootstrap draws views, each town's among themselves; all arms, and all choices of labels, get the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.benchmark.aerial import AGREEMENT, DARK, DAY, LOW, Counts, Table, Unit
from semantic_mapper.benchmark.aerial_arms import BRIDGE, ROOF
from semantic_mapper.benchmark.claims import Result
from semantic_mapper.types import Float64

RESAMPLES = 2000

Draws = Mapping[Unit, Float64]  # how often each view was drawn, (B,)


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


def _miou(counts: Float64) -> Float64:
    """(B, L, L + 1) -> (B,) in points, the rules of ``ConfusionMatrix.iou``."""
    hits, occurring = np.diagonal(counts, axis1=1, axis2=2), counts.sum(axis=2)
    union = occurring + counts[:, :, :-1].sum(axis=1) - hits
    iou = np.divide(hits, union, out=np.zeros_like(hits), where=occurring > 0)
    present = (occurring > 0).sum(axis=1)
    return 100 * np.divide(iou.sum(axis=1), present, out=np.full(len(counts), np.nan), where=present > 0)


def _accuracy(counts: Float64) -> Float64:
    """Mean over the classes in the truth of the fraction that is right, in points."""
    hits, occurring = np.diagonal(counts, axis1=1, axis2=2), counts.sum(axis=2)
    right = np.divide(hits, occurring, out=np.zeros_like(hits), where=occurring > 0)
    return 100 * right.sum(axis=1) / (occurring > 0).sum(axis=1)


def _fraction(counts: Float64) -> Float64:
    return 100 * counts[:, 0, 0] / np.maximum(counts[:, 0, 1], 1)


def _drop(counts: Sequence[Float64]) -> Float64:
    return 100 * (1 - _miou(counts[1]) / _miou(counts[0]))


MIOU = Measure("mIoU", (DAY,), lambda counts: _miou(counts[0]))
IN_THE_DARK = Measure("mIoU in the dark", (DARK,), lambda counts: _miou(counts[0]))
FROM_LOW = Measure("mIoU from low", (LOW,), lambda counts: _miou(counts[0]))
CONSISTENCY = Measure("consistency", (AGREEMENT,), lambda counts: _fraction(counts[0]))
DARK_DROP = Measure("relative drop in the dark", (DAY, DARK), _drop)
LOW_DROP = Measure("relative drop from low", (DAY, LOW), _drop)
BRIDGE_PAIR = Measure("accuracy, bridge or road", (BRIDGE,), lambda counts: _accuracy(counts[0]))
ROOF_PAIR = Measure("accuracy, roof or road", (ROOF,), lambda counts: _accuracy(counts[0]))


@dataclass(frozen=True, slots=True)
class AerialClaim:
    """``measure`` of ``first`` minus ``factor`` times that of ``second`` lies between ``least`` and ``most``.

    Args:
        name: What is claimed.
        paper: Its figures, as text; empty for a check of the suite itself.
        measure: Figure.
        first: Arm.
        second: Arm; None = 0.
        least, most: Bounds in points. A bound of 0 or above from below is a gain: its interval must lie above 0, too.
        factor: Of ``second``.
    """

    name: str
    paper: str
    measure: Measure
    first: str
    second: str | None = None
    least: float = -np.inf
    most: float = np.inf
    factor: float = 1.0

    @property
    def accepted_if(self) -> str:
        """The bounds as text."""
        if np.isinf(self.least):
            return f"<= {self.most:g}"
        if np.isinf(self.most):
            return f">= {self.least:g}" if self.least > 0 else "> 0"
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class AerialResult:
    """What came of a claim; figures in points, None where it was not run."""

    claim: AerialClaim
    result: Result
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    views: int = 0


CLAIMS = (
    AerialClaim("gate: the colour of a pixel says little", "", MIOU, "color", most=15.0),
    AerialClaim("gate: patches do not tell bridges from roads", "", BRIDGE_PAIR, "patch", most=55.0),
    AerialClaim("gate: patches do not tell roofs from roads", "", ROOF_PAIR, "patch", most=55.0),
    AerialClaim("above U-Net", "58.7 / 43.1", MIOU, "irt-rttc", "unet", least=10.0),
    AerialClaim("above labels carried by the grid's depth", "", MIOU, "irt-rttc", "warp", least=0.0),
    AerialClaim("above Semantic-NeRF", "51.1 / 46.8", MIOU, "irt-rttc", "semantic-nerf", least=2.0),
    AerialClaim("RTTC above B", "58.7 / 53.4", MIOU, "irt-rttc", "irt-b", least=3.0),
    AerialClaim("RTT above RT", "57.5 / 53.9", MIOU, "irt-rtt", "irt-rt", least=0.0),
    AerialClaim("RTC above RT", "56.8 / 53.9", MIOU, "irt-rtc", "irt-rt", least=0.0),
    AerialClaim("above Color-NeRF", "58.7 / 56.8", MIOU, "irt-rttc", "irt-colour", least=0.0),
    AerialClaim("stage 1 brings", "a figure only", MIOU, "irt-rttc", "irt-no-stage-1", least=10.0),
    AerialClaim("dark: half of the U-Net's drop", "18 / 81", DARK_DROP, "irt-rttc", "unet", most=0.0, factor=0.5),
    AerialClaim(
        "dark: half of the drop of a U-Net trained in the dark",
        "",
        DARK_DROP,
        "irt-rttc",
        "unet-dimmed",
        most=0.0,
        factor=0.5,
    ),
    AerialClaim(
        "from low: half of the U-Net's drop", "a figure only", LOW_DROP, "irt-rttc", "unet", most=0.0, factor=0.5
    ),
    AerialClaim("more consistent than the U-Net", "", CONSISTENCY, "irt-rttc", "unet", least=3.0),
)


def figure(table: Table, arm: str, measure: Measure) -> float | None:
    """A figure of an arm in points; None where it was not scored."""
    kinds = [table.get((arm, kind)) for kind in measure.kinds]
    if any(not units for units in kinds):
        return None
    return float(measure.value([_sum(units, None) for units in kinds if units])[0])


def check_aerial_claim(claim: AerialClaim, table: Table, *, seed: int = 0) -> AerialResult:
    """Judge a claim by the views that both arms have been scored on.

    Args:
        claim: What to judge.
        table: Counts by arm, by what is scored, and by view.
        seed: Of the bootstrap.
    """
    arms = [claim.first] if claim.second is None else [claim.first, claim.second]
    shared = {kind: _shared(table, arms, kind) for kind in claim.measure.kinds}
    views = min(map(len, shared.values()))
    if views < 2:
        return AerialResult(claim, "not run", views=views)
    observed, drawn = np.zeros(1), np.zeros(RESAMPLES)
    draws = {kind: _draws(units, np.random.default_rng((seed, k))) for k, (kind, units) in enumerate(shared.items())}
    for arm, sign in zip(arms, (1.0, -claim.factor), strict=False):
        counts = [{unit: table[arm, kind][unit] for unit in units} for kind, units in shared.items()]
        observed = observed + sign * claim.measure.value([_sum(c, None) for c in counts])
        drawn = drawn + sign * claim.measure.value([_sum(c, draws[k]) for c, k in zip(counts, shared, strict=True)])
    low, high = np.nanpercentile(drawn, (2.5, 97.5))
    difference = float(observed[0])
    right = claim.least <= difference <= claim.most and not (claim.least >= 0 >= low)
    return AerialResult(claim, "accepted" if right else "refused", difference, float(low), float(high), views)


def check_aerial_claims(table: Table, *, seed: int = 0) -> list[AerialResult]:
    """``check_aerial_claim`` of each of ``CLAIMS``."""
    return [check_aerial_claim(claim, table, seed=seed) for claim in CLAIMS]


def _shared(table: Table, arms: Sequence[str], kind: str) -> list[Unit]:
    """Views that all arms have."""
    units = [set(table.get((arm, kind), {})) for arm in arms]
    return sorted(set.intersection(*units))


def _draws(units: Sequence[Unit], rng: np.random.Generator) -> dict[Unit, Float64]:
    """How often each view is drawn (RESAMPLES,), each town's among themselves."""
    found: dict[Unit, Float64] = {}
    for town in sorted({town for town, _ in units}):
        own = [unit for unit in units if unit[0] == town]
        times = rng.multinomial(len(own), np.full(len(own), 1 / len(own)), size=RESAMPLES).astype(np.float64)
        found |= dict(zip(own, times.T, strict=True))
    return found


def _sum(counts: Mapping[Unit, Counts], draws: Draws | None) -> Float64:
    """(B, L, L + 1) counts of all views, as often as each was drawn; B = 1 without draws."""
    stack: NDArray[np.float64] = np.stack([counts[unit] for unit in counts]).astype(np.float64)
    times = np.ones((1, len(counts))) if draws is None else np.stack([draws[unit] for unit in counts], axis=1)
    return np.einsum("bs,slc->blc", times, stack, optimize=True)
