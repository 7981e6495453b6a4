"""Why a film gives no poses, and what to do about it."""

from collections.abc import Sequence

import numpy as np

from semantic_mapper.errors import ImportSourceError
from semantic_mapper.replay.sfm.colmap import LINK_MATCHES, UNKNOWN_FOCAL, FocalCheck, Outcome, turn_fraction
from semantic_mapper.replay.sfm.film import FilmLook

LEAST_PICKS = 8
STILL = 0.1  # of the image's width: less motion in all is a camera that stands still
MOST_DARK = 0.7  # of the frames
LEAST_FEATURES = 80  # of a frame that can be matched, the median
LEAST_LINKED = 0.5  # of the neighbours in the sequence
MOST_TURNED = 0.9  # of the pairs some steps apart, that a turn explains: their model is noise, however large
LEAST_MODEL = 0.6  # of the picked frames in the largest model
LEAST_ANGLE_DEG = 1.0  # between the rays to a point, the median: less is a camera that turns on the spot
SMALL_ANGLE_DEG = 4.0  # ... less, and depths are uncertain
UNCERTAIN_FOCAL, WRONG_FOCAL = 0.05, 0.1  # of a given focal length: its difference from what the pictures say
LEAST_SIGMAS = 10.0  # of this difference: rolling shutter and the like make a few
UNSURE_FOCAL = 0.02  # standard deviation of a focal length that is worth a note
_HOW = "film again: walk slowly, sideways past things with texture, in good light"
TURNING = (
    "the camera only turns on the spot, or sees one flat surface: from one place nothing can be measured; walk while "
    "filming, a step or more to the side for each turn"
)


def refuse_look(film: object, look: FilmLook, picks: int) -> None:
    """Raises ImportSourceError where the first look at a film shows that it is dark, still, or too short."""
    count = len(look.index)
    dark, seconds = float(look.dark.mean()), (look.stamp_ns[-1] - look.stamp_ns[0]) / 1e9
    if dark > MOST_DARK:
        raise ImportSourceError(
            f"{film}: {100 * dark:.0f} % of its frames are black or show nothing; is the lens covered? {_HOW}"
        )
    way = float(np.nansum(look.motion))
    still = way < STILL and count >= LEAST_PICKS and np.isfinite(look.motion).mean() > 0.5
    if still or picks < LEAST_PICKS:
        raise ImportSourceError(
            f"{film}: is too short, or the camera does not move: {count} frames in {seconds:.1f} s, whose picture "
            f"shifts by {100 * way:.1f} % of its width, give {picks} views a step apart, {LEAST_PICKS} needed; film "
            "for ten seconds or more while walking, or map a camera that stands still with poses of kind 'fixed'"
        )


def refuse_features(film: object, features: Sequence[int]) -> None:
    """Raises ImportSourceError for a film whose frames have too few features to be found again."""
    found = float(np.median(features))
    if found < LEAST_FEATURES:
        raise ImportSourceError(
            f"{film}: its frames are blurred, or show surfaces without texture: half of them have fewer than "
            f"{found:.0f} features, {LEAST_FEATURES} needed; hold the camera still enough, wipe the lens, and {_HOW}"
        )


def refuse_outcome(film: object, outcome: Outcome, times_s: Sequence[float], spans: Sequence[Sequence[int]]) -> None:
    """Raises ImportSourceError for what structure from motion could not put together.

    ``times_s`` are those of the picked frames, ``spans`` the places in the sequence of the frames of each model of the
    best attempt, the largest first.
    """
    picks = len(times_s)
    complete = bool(spans) and len(spans[0]) >= LEAST_MODEL * picks
    linked = {p.second for p in outcome.pairs if p.matches >= LINK_MATCHES and p.second - p.first == 1}
    reason = ""
    if len(linked) < LEAST_LINKED * (picks - 1) and not complete:
        reason = (
            f"its pictures do not match each other: {len(linked)} of {picks - 1} neighbours show the same place; the "
            f"camera moves too fast, or what it sees changes or has no texture; {_HOW}"
        )
    elif turn_fraction(outcome.pairs) >= MOST_TURNED or (
        not complete and turn_fraction(outcome.pairs, flat=True) >= 0.5
    ):
        reason = TURNING  # what models a camera that turns gives are noise
    elif not spans:
        reason = (
            "no two of its pictures show one place from two sides far enough apart; give --calibration or "
            f"--focal-prior where the lens is unusual, film a longer way, or {_HOW}"
        )
    elif not complete:
        parts = [f"{times_s[min(s)]:.1f} to {times_s[max(s)]:.1f} s ({len(s)} of {picks} views)" for s in spans[:4]]
        reason = (
            f"falls into parts that do not hang together: {'; '.join(parts)}; cut it into one film for each scene, or "
            "film again a longer way, without cuts and fast turns"
        )
    if reason:
        raise ImportSourceError(f"{film}: {reason}")


def focal_note(film: object, calibration: object, focal_px: float, check: FocalCheck) -> list[str]:
    """What is wrong with the focal length of a calibration, ``focal_px`` of the film; empty where nothing is, or the
    film does not tell. ImportSourceError where it is far off."""
    off = abs(check.factor - 1)
    if off < UNCERTAIN_FOCAL or check.sigmas < LEAST_SIGMAS:
        return []
    text = (
        f"the focal length of {calibration} is {focal_px:.0f} px of the film, and its pictures fit "
        f"{focal_px * check.factor:.0f} px better; calibrate in the mode (size, zoom, stabilisation) of the film, or "
        "leave out --calibration to have the focal length found"
    )
    if off > WRONG_FOCAL:
        raise ImportSourceError(f"{film}: {text}")
    return [text]


def baseline_notes(ahead: bool, angle_deg: float, focal_sigma: float | None) -> list[str]:
    """What a film tells badly, because its camera hardly moves sideways: by whether its model begins with two frames
    straight ahead of each other, the median angle between rays to a point, and the focal length's ``focal_sigma``."""
    notes: list[str] = []
    if ahead or angle_deg < SMALL_ANGLE_DEG:
        notes.append(
            f"the camera {'goes straight ahead' if ahead else 'hardly moves sideways'}: half of the points are seen "
            f"from less than {angle_deg:.1f} degrees apart, so their depths are uncertain"
        )
    if focal_sigma is not None and focal_sigma > UNSURE_FOCAL:
        assumed = "assumed: by the film alone it is " if focal_sigma > UNKNOWN_FOCAL else ""
        notes.append(
            f"the focal length is {assumed}exact to {100 * focal_sigma:.2g} % only; a straight way fits many nearly as "
            "well, and lengths along it against those across are off by as much; calibrate the camera and give "
            "--calibration"
        )
    return notes
