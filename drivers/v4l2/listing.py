"""Which V4L2 cameras are connected."""

from __future__ import annotations

from pathlib import Path

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.drivers.v4l2 import ioctls, paths

SHOWN_FORMATS = 8


def list_devices() -> list[FoundCamera]:
    """One row for each device that gives images; what cannot be opened is listed with the reason."""
    rows = [_describe(node) for node in paths.video_nodes()]
    return [row for row in rows if row is not None]


def _describe(node: Path) -> FoundCamera | None:
    """None where it is no camera: the metadata of one, a codec, or gone again."""
    try:
        with ioctls.opened(node) as fd:
            who = ioctls.query_capability(fd)
            formats = ioctls.list_formats(fd) if who.captures else ()
    except FileNotFoundError:
        return None
    except PermissionError:
        return FoundCamera("v4l2", "?", str(node), "no permission: add yourself to the group `video` and log in again")
    except OSError as error:
        return FoundCamera("v4l2", "?", str(node), f"does not answer: {error.strerror}")
    if not who.captures:
        return None
    note = f"{node.name}; {' '.join(formats[:SHOWN_FORMATS]) or 'no formats'}; {who.driver} at {who.bus}"
    return FoundCamera("v4l2", who.card, str(paths.stable_path(node)), note)
