"""Claims of a paper as relative checks: the difference of two scores, its interval over scenes, and the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from semantic_mapper.evaluation.bootstrap import paired_bootstrap
from semantic_mapper.evaluation.metrics import ConfusionMatrix

Result = Literal["accepted", "refused", "not run"]

Score = tuple[str, str]  # arm, and what of it is scored
Scores = Mapping[Score, Mapping[int, ConfusionMatrix]]  # by scene


@dataclass(frozen=True, slots=True)
class Claim:
    """``first`` minus ``factor`` times ``second``, in points of mIoU, lies between ``least`` and ``most``.

    Args:
        name: What is claimed.
        paper: Its figures, as text; empty for a check of the suite itself.
        first: Score.
        second: Score; None = 0.
        least, most: Bounds in points. A bound above 0 from below is a gain: its interval must lie above 0, too.
        factor: Of ``second``.
    """

    name: str
    paper: str
    first: Score
    second: Score | None = None
    least: float = -np.inf
    most: float = np.inf
    factor: float = 1.0

    @property
    def accepted_if(self) -> str:
        """The bounds as text."""
        if np.isinf(self.least):
            return f"<= {self.most:g}"
        return f">= {self.least:g}" if np.isinf(self.most) else f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """What came of a claim; figures in points of mIoU, None where it was not run or has fewer than 2 scenes."""

    claim: Claim
    result: Result
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    scenes: int = 0


def check_claim(claim: Claim, scores: Scores, *, seed: int = 0) -> ClaimResult:
    """Judge a claim by the scenes that both scores have, with a 95 % bootstrap interval over them.

    Args:
        claim: What to judge.
        scores: Confusion matrices by score and scene.
        seed: Of the bootstrap.
    """
    first = scores.get(claim.first, {})
    second = first if claim.second is None else scores.get(claim.second, {})
    scenes = sorted(first.keys() & second.keys())
    if len(scenes) < 2:
        return ClaimResult(claim, "not run", scenes=len(scenes))
    factor = 0.0 if claim.second is None else claim.factor
    found = paired_bootstrap([first[s] for s in scenes], [second[s] for s in scenes], factor=factor, seed=seed)
    difference, low, high = (100 * x for x in (found.observed, found.low, found.high))
    right = claim.least <= difference <= claim.most and not (claim.least > 0 >= low)
    return ClaimResult(claim, "accepted" if right else "refused", difference, low, high, len(scenes))


def check_claims(claims: Sequence[Claim], scores: Scores, *, seed: int = 0) -> list[ClaimResult]:
    """``check_claim`` of each."""
    return [check_claim(claim, scores, seed=seed) for claim in claims]
