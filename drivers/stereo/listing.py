"""Which connected cameras may be stereo pairs: those that offer images as wide as two side by side."""

from __future__ import annotations

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.drivers.v4l2 import ioctls, paths

WIDER = 2.4  # width over height; the widest single images are 21:9


def list_devices() -> list[FoundCamera]:
    """V4L2 cameras with images of such a size; one that cannot be opened is listed with the V4L2 cameras."""
    found: list[FoundCamera] = []
    for node in paths.video_nodes():
        try:
            with ioctls.opened(node) as fd:
                who = ioctls.query_capability(fd)
                sizes = ioctls.list_sizes(fd) if who.captures else ()
        except OSError:
            continue
        wide = [f"{width}x{height}" for width, height in sizes if width > WIDER * height]
        if wide:
            note = f"{node.name}; side by side {' '.join(wide)}"
            found.append(FoundCamera("stereo", who.card, str(paths.stable_path(node)), note))
    return found
