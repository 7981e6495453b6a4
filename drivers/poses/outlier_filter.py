"""Which poses are believed: the first ones once some agree with each other, then those that can have been reached."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.drivers.poses.config import PoseChecks
from semantic_mapper.drivers.poses.motion import StampedPose
from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Float64, PosedFrame

FAR = 2.0  # times what is allowed: a jump, whatever comes after it
HELD = 3  # times ``init_consensus``: this many frames are held back at most while the first poses do not agree

_log = get_logger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class FilterResult:
    """What comes of a frame, and of those that were held back before it.

    Args:
        passed: Frames to give, in the order of capture.
        outliers, uninitialized: Frames to leave out, each with why: it cannot have been reached from poses that are
            believed; or no poses are believed yet, and it did not agree with those around it.
        waiting: Why frames are held back though they contradict each other; empty where they do not.
    """

    passed: tuple[PosedFrame, ...] = ()
    outliers: tuple[tuple[PosedFrame, str], ...] = ()
    uninitialized: tuple[tuple[PosedFrame, str], ...] = ()
    waiting: str = ""


class PoseOutlierFilter:
    """Judges the poses of one camera.

    Args:
        checks: The limits.
        exact: The first pose is beyond doubt.
    """

    def __init__(self, checks: PoseChecks, exact: bool = False) -> None:
        self._beginning: _Initializer | None = _Initializer(checks, 1 if exact else checks.init_consensus)
        self._jumps = _JumpGate(checks)

    def take(self, frame: PosedFrame) -> FilterResult:
        """Judge the next frame."""
        if self._beginning is not None:
            verdict = self._beginning.take(frame)
            if verdict.passed:
                self._beginning = None
                self._jumps.believe(_sample(verdict.passed[-1]))
            return verdict
        reason = self._jumps.refusal(_sample(frame))
        return FilterResult(outliers=((frame, reason),)) if reason else FilterResult((frame,))

    def follow(self, motion: Float64) -> None:
        """The world of the poses to come is another one: ``motion`` (4, 4) takes the last pose there."""
        self._jumps.follow(motion)

    def abandon(self) -> FilterResult:
        """The world of the poses has ended: what is held back is left out."""
        why = "the camera began another world before its first poses were sure"
        return FilterResult() if self._beginning is None else self._beginning.give_up(why)

    def end(self) -> FilterResult:
        """No more will come: what is held back passes where no pose has contradicted it."""
        return FilterResult() if self._beginning is None else self._beginning.end()


class _Initializer:
    """Holds frames back until ``agree`` poses agree that nothing contradicts; nothing that agreed is lost.

    Frames stand in chains, in each of which a pose can be reached from the one before. A chain is believed when it is
    ahead of every other by ``agree``: a wrong first pose loses against what follows it, and of two worlds that take
    turns none is believed.
    """

    def __init__(self, checks: PoseChecks, agree: int) -> None:
        self._checks = checks
        self._agree = agree
        self._chains: list[list[PosedFrame]] = []  # the one that was last added to is the last

    def take(self, frame: PosedFrame) -> FilterResult:
        """The frames of the chain that is believed now, or none."""
        chain = self._chain_of(frame)
        chain.append(frame)
        self._chains = [*(c for c in self._chains if c is not chain), chain]
        others = self._chains[:-1]
        if len(chain) - max((len(c) for c in others), default=0) >= self._agree:
            why = f"its pose does not agree with {len(chain)} others that agree with each other"
            return FilterResult(tuple(chain), outliers=tuple((f, why) for f in _in_order(others)))
        waiting = self._contradiction()
        if sum(len(c) for c in self._chains) < HELD * self._agree:
            return FilterResult(waiting=waiting)
        return self.give_up(waiting)

    def end(self) -> FilterResult:
        """See ``PoseOutlierFilter``."""
        if len(self._chains) == 1:
            return FilterResult(tuple(self._chains[0]))
        return self.give_up(self._contradiction())

    def give_up(self, why: str) -> FilterResult:
        """Leave out what is held back."""
        held, self._chains = _in_order(self._chains), []
        return FilterResult(uninitialized=tuple((f, why) for f in held), waiting=why)

    def _chain_of(self, frame: PosedFrame) -> list[PosedFrame]:
        """The one that the frame goes on from most closely; a new one where there is none.

        Not the longest: what is within reach of a chain grows while another one goes on.
        """
        shares = [(_share(self._checks, _sample(chain[-1]), _sample(frame)), chain) for chain in self._chains]
        fraction, chain = min(shares, key=lambda found: found[0], default=(np.inf, []))
        return chain if fraction <= 1 else []

    def _contradiction(self) -> str:
        if len(self._chains) < 2:
            return ""
        before, after = sorted((self._chains[-2][-1], self._chains[-1][-1]), key=lambda f: f.stamp_ns)
        return (
            f"the first poses do not agree with each other ({_jump(self._checks, _sample(before), _sample(after))}); "
            f"none is believed before {self._agree} agree (init_consensus)"
        )


class _JumpGate:
    """Lets poses pass that a camera can have reached from the last one; and the new place, once it is sure of it.

    What is within reach grows with the time since the last pose that passed. A source that has jumped far and goes on
    from there must not pass because of that; one that jumps back may.
    """

    def __init__(self, checks: PoseChecks) -> None:
        self._checks = checks
        self._last: StampedPose | None = None
        self._elsewhere: StampedPose | None = None  # the last refused pose, and ...
        self._agreeing = 0  # ... how many in a row agree with it, and ...
        self._far = False  # ... whether the first of them was so far that no quick movement explains it

    def believe(self, sample: StampedPose) -> None:
        """Go on from here."""
        self._last, self._elsewhere, self._agreeing = sample, None, 0

    def follow(self, motion: Float64) -> None:
        """See ``PoseOutlierFilter``."""
        if self._last is not None:
            self._last = replace(self._last, T=motion @ self._last.T)
        if self._elsewhere is not None:
            self._elsewhere = replace(self._elsewhere, T=motion @ self._elsewhere.T)

    def refusal(self, sample: StampedPose) -> str:
        """Why a pose is refused; empty where it passes."""
        last = sample if self._last is None else self._last
        reason = _jump(self._checks, last, sample)
        follows = self._elsewhere is not None and not _jump(self._checks, self._elsewhere, sample)
        if follows and self._far:
            reason = self._elsewhere_trouble(last, sample)
        if reason:
            self._agreeing = self._agreeing + 1 if follows else 1
            if not follows:
                self._far = bool(_jump(self._checks, last, sample, FAR))
            self._elsewhere = sample
            if not 0 < self._checks.relocalize_after < self._agreeing:
                return reason
            _log.warning("jump_accepted", reason=reason, agreeing=self._agreeing)
        self.believe(sample)
        return ""

    def _elsewhere_trouble(self, last: StampedPose, sample: StampedPose) -> str:
        moved_m, turned_deg, seconds = _way(last, sample)
        needed = self._checks.relocalize_after
        way_out = (
            f"after {needed} of them that agree with each other they are believed (relocalize_after)"
            if needed
            else "if they are right now, start the launch again, or set checks = { relocalize_after = N } in the table "
            "`poses`: after a jump, N poses in a row that agree with each other are believed then, such as N = 30"
        )
        return (
            f"the poses have jumped and go on from there, now {moved_m:.2f} m and {turned_deg:.0f} degrees from the "
            f"last one that was believed, {seconds:.1f} s ago; they are left out, since those of another world would "
            f"spoil the map; {way_out}"
        )


def _sample(frame: PosedFrame) -> StampedPose:
    return StampedPose(frame.stamp_ns, frame.T_world_camera)


def _in_order(chains: list[list[PosedFrame]]) -> list[PosedFrame]:
    return sorted((frame for chain in chains for frame in chain), key=lambda f: f.stamp_ns)


def _way(a: StampedPose, b: StampedPose) -> tuple[float, float, float]:
    """Metres, degrees and seconds from a to b."""
    moved_m = float(np.linalg.norm(b.T[:3, 3] - a.T[:3, 3]))
    turned_deg = float(np.rad2deg(np.linalg.norm(rotation_vector(invert_pose(a.T) @ b.T))))
    return moved_m, turned_deg, (b.stamp_ns - a.stamp_ns) / 1e9


def _share(checks: PoseChecks, a: StampedPose, b: StampedPose) -> float:
    """The way from a to b by what is allowed in that time; above 1 it is a jump."""
    moved_m, turned_deg, seconds = _way(a, b)
    allowed_m, allowed_deg = _allowed(checks, seconds)
    return max(moved_m / allowed_m, turned_deg / allowed_deg)


def _allowed(checks: PoseChecks, seconds: float) -> tuple[float, float]:
    """Metres and degrees that are believed in that time."""
    return checks.slack_m + checks.max_speed_m_s * seconds, checks.slack_deg + checks.max_turn_deg_s * seconds


def _jump(checks: PoseChecks, a: StampedPose, b: StampedPose, times: float = 1.0) -> str:
    """Why b cannot have been reached from a, with this many times the limits; empty where it can."""
    moved_m, turned_deg, seconds = _way(a, b)
    allowed_m, allowed_deg = (times * limit for limit in _allowed(checks, seconds))
    if moved_m <= allowed_m and turned_deg <= allowed_deg:
        return ""
    return (
        f"the pose jumps by {moved_m:.2f} m and {turned_deg:.0f} degrees in {seconds:.3f} s; at most "
        f"{allowed_m:.2f} m and {allowed_deg:.0f} degrees are believed (max_speed_m_s, max_turn_deg_s)"
    )
