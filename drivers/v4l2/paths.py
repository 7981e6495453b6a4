"""Names of video devices that stay the same when a camera is plugged in again or comes up under another index."""

from __future__ import annotations

import re
from pathlib import Path

DEVICES = Path("/dev")
LINKS = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))  # by model and serial number; by the port it hangs on


def stable_path(device: Path) -> Path:
    """The link that udev keeps for a device, by-id where there is one; the device's own path where there is none."""
    if any(device.parent == folder for folder in LINKS):
        return device
    for folder in LINKS:
        for link in sorted(folder.glob("*")) if folder.is_dir() else ():
            if link.resolve() == device.resolve():
                return link
    return device


def video_nodes() -> list[Path]:
    """All /dev/video* in the order of their numbers."""
    nodes = [p for p in DEVICES.glob("video*") if re.fullmatch(r"video\d+", p.name)]
    return sorted(nodes, key=lambda p: int(p.name.removeprefix("video")))
