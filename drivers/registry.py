"""Kinds of cameras by name. Each is a module ``drivers.<kind>.camera`` that is loaded when it is requested.

It offers ``Config``, a ``msgspec.Struct``; ``open_camera(config, camera_id)``, a ``Camera`` that is not open yet
(``CameraError``, ``ConfigError``: it cannot work with this config); and ``list_devices()``, a list of ``FoundCamera``
(``CameraError``, ``DependencyError``: it cannot be searched for), which opens nothing for longer than a question.
"""

import importlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from semantic_mapper.config import convert_config, nearest
from semantic_mapper.drivers.base import Camera
from semantic_mapper.errors import CameraError, ConfigError, DependencyError

KINDS = ("v4l2", "opencv", "stereo", "oak", "realsense")
SEARCH_S = 2.0  # how long a device is looked for before it counts as missing
_SEARCH_STEP_S = 0.2


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that is connected."""

    kind: str  # of ``KINDS``
    name: str  # as the device calls itself
    address: str  # what its driver's config takes: a path, a serial number, an IP address
    note: str = ""  # what else is worth knowing, for people


def load_driver(kind: str) -> Any:
    """The module of a kind; ``ConfigError``: unknown, ``DependencyError``: something is not installed."""
    if kind not in KINDS:
        raise ConfigError(f"no kind of camera is called '{kind}'{nearest(kind, KINDS)}")
    try:
        return importlib.import_module(f"semantic_mapper.drivers.{kind}.camera")
    except ImportError as error:
        raise DependencyError(f"cameras of kind '{kind}' cannot be used here: {error}") from error


def open_camera(kind: str, config: Mapping[str, Any], camera_id: str, where: str) -> Camera:
    """A camera of a kind, not open yet; ``config`` is plain data from ``where``, checked against the kind's ``Config``.

    Raises ConfigError, CameraError, DependencyError: a bad setting, one that cannot work, or something is not
    installed.
    """
    driver = load_driver(kind)
    return driver.open_camera(convert_config(dict(config), driver.Config, where), camera_id)


def find_cameras(kinds: Sequence[str] = KINDS) -> tuple[list[FoundCamera], dict[str, str]]:
    """All cameras that are connected, and why a kind could not be searched for."""
    found: list[FoundCamera] = []
    unknown: dict[str, str] = {}
    for kind in kinds:
        try:
            found += load_driver(kind).list_devices()
        except (CameraError, DependencyError) as error:
            unknown[kind] = str(error)
    return found, unknown


def find_device(search: Callable[[], Mapping[str, Any]], kind: str, address: str, fix: str) -> Any:
    """The only device that ``search`` finds by name, looked for until it is there.

    Raises CameraError: no device of this address (empty: of any), or several.
    """
    deadline = time.monotonic() + SEARCH_S
    while not (found := search()) and time.monotonic() < deadline:
        time.sleep(_SEARCH_STEP_S)
    if not found:
        what = f"the {kind} '{address}' is not connected" if address else f"no {kind} camera is connected"
        raise CameraError(f"{what}, or it is in use: {fix}")
    if len(found) > 1:
        raise CameraError(f"several {kind} cameras are connected: {', '.join(found)}; say which one by `device`")
    return next(iter(found.values()))
