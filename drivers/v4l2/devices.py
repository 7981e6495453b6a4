"""Which V4L2 cameras are connected, under names that stay the same when one is plugged in again."""

import re
from pathlib import Path

import semantic_mapper.drivers.v4l2.ioctls as ioctls
from semantic_mapper.drivers.registry import FoundCamera

SHOWN_FORMATS = 8
DEVICES = Path("/dev")
LINKS = (Path("/dev/v4l/by-id"), Path("/dev/v4l/by-path"))  # by model and serial number; by the port it hangs on


def stable_path(device: Path) -> Path:
    """The link that udev keeps for a device, by-id where there is one; else the device's own path."""
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


def list_devices() -> list[FoundCamera]:
    """One row for each device that gives images; what cannot be opened is listed with the reason."""
    found: list[FoundCamera] = []
    for node in video_nodes():
        try:
            with ioctls.opened(node) as fd:
                who = ioctls.query_capability(fd)
                if not who.captures:  # the metadata of a camera, or a codec
                    continue
                formats = " ".join(ioctls.list_formats(fd)[:SHOWN_FORMATS]) or "no formats"
            note = f"{node.name}; {formats}; {who.driver} at {who.bus}"
            found.append(FoundCamera("v4l2", who.card, str(stable_path(node)), note))
        except FileNotFoundError:  # gone again
            continue
        except OSError as error:
            note = f"does not answer: {error.strerror} (without permission: add yourself to the group `video`)"
            found.append(FoundCamera("v4l2", "?", str(node), note))
    return found
