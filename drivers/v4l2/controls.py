"""Exposure, white balance, gain and other controls: set, read back, and what differs is told."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from semantic_mapper.drivers.v4l2 import ioctls
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.ioctls import Control


@dataclass(frozen=True, slots=True)
class _Wish:
    """A value for a control; ``value`` None = the device's default, ``needed`` = its lack is worth telling."""

    setting: str
    control: int
    value: int | None
    needed: bool = True


def apply_controls(path: Path, config: Config) -> tuple[str, ...]:
    """Set what the config asks for; one sentence for each control that did not follow.

    Controls that the config leaves automatic are set so: a camera keeps what was set before.

    Raises:
        OSError: the device is gone.
    """
    with ioctls.opened(path) as fd:
        controls = ioctls.list_controls(fd)
        by_id = {c.id: c for c in controls.values()}
        warnings = [_set(fd, by_id.get(wish.control), wish) for wish in _wishes(config)]
        for name, value in config.controls.items():
            if name in controls:
                warnings.append(_set(fd, controls[name], _Wish(name, controls[name].id, value)))
            else:
                near = difflib.get_close_matches(name, controls, n=1, cutoff=0.5)
                hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(controls) or 'none'}"
                warnings.append(f"it has no control '{name}'; {hint}")
    return tuple(trouble for trouble in warnings if trouble)


def _wishes(config: Config) -> list[_Wish]:
    """Automatic modes come first: while one is on, a device refuses or forgets the value."""
    wishes: list[_Wish] = []
    if config.exposure_ms:
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_AUTO, ioctls.EXPOSURE_MANUAL, needed=False))
        tenths_ms = max(1, round(config.exposure_ms * 10))
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_ABSOLUTE, tenths_ms))
    else:
        wishes.append(_Wish("exposure_ms", ioctls.EXPOSURE_AUTO, None, needed=False))
    manual = bool(config.white_balance_k)
    wishes.append(_Wish("white_balance_k", ioctls.AUTO_WHITE_BALANCE, int(not manual), needed=False))
    if manual:
        wishes.append(_Wish("white_balance_k", ioctls.WHITE_BALANCE_TEMPERATURE, config.white_balance_k))
    if config.gain >= 0:
        wishes.append(_Wish("gain", ioctls.AUTOGAIN, 0, needed=False))
        wishes.append(_Wish("gain", ioctls.GAIN, config.gain))
    return wishes


def _set(fd: int, control: Control | None, wish: _Wish) -> str:
    """What went otherwise than wished; empty where nothing did."""
    if control is None:
        return f"it has no control for {wish.setting}" if wish.needed else ""
    value = control.default if wish.value is None else wish.value
    span = f"{control.name} goes from {control.minimum} to {control.maximum}"
    try:
        ioctls.set_control(fd, control.id, value)
        given = ioctls.get_control(fd, control.id)
    except OSError as error:
        return f"{wish.setting}: it refuses {control.name} = {value} ({error.strerror or error}); {span}"
    return "" if given == value else f"{wish.setting}: asked for {control.name} = {value}, it has {given}; {span}"
