"""DepthAI, which OAK cameras are connected, and why one cannot be had."""

from __future__ import annotations

import functools
import importlib
import os
import re
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import CameraError, DependencyError

USB_VENDOR = "03e7"
SYSFS_USB = Path("/sys/bus/usb/devices")
USB_NODES = Path("/dev/bus/usb")
UDEV_RULE = (
    """echo 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"' | sudo tee /etc/udev/rules.d/80-movidius.rules """
    "&& sudo udevadm control --reload-rules && sudo udevadm trigger"
)
_BUSY = ("X_LINK_BOOTED", "X_LINK_GATE_BOOTED")
_IP = re.compile(r"\d{1,3}(\.\d{1,3}){3}\Z")
_SEARCH_STEP_S = 0.2


@functools.cache
def load_depthai() -> Any:
    """Import DepthAI once and return the module; ``DependencyError`` where it cannot be loaded."""
    # Its handler of signals would end the process where writing to a full disk is an error (SIGXFSZ), and print a
    # trace of its own in the place of Python's.
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    # A robot does not report to its maker unless it is instructed to, and leaves no files for that.
    os.environ.setdefault("DEPTHAI_TELEMETRY", "0")
    os.environ.setdefault("DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS", "1")
    try:
        return importlib.import_module("depthai")
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"DepthAI cannot be loaded: {error}. Run `make setup`, or install it yourself: "
            "pip install 'depthai>=3.12,<4'"
        ) from error


def list_devices() -> list[FoundCamera]:
    """OAK cameras on USB and in the networks of this machine, by name."""
    return sorted((_describe(info) for info in _search()), key=lambda device: (device.name, device.address))


def find_device(address: str, search_s: float) -> Any:
    """DepthAI's ``DeviceInfo`` of one device, which is looked for until it is there.

    Args:
        address: Id, IP address or USB path; empty for the only one that is connected.
        search_s: How long to look; then ``CameraError`` says how to fix it.
    """
    deadline = time.monotonic() + search_s
    while True:
        found = _search(address)
        names = ", ".join(f"{d.getDeviceId()} ({d.name})" for d in found)
        if len(found) > 1:
            raise CameraError(f"several OAK cameras are connected: {names}; say which one by `device`")
        if found and found[0].state.name not in _BUSY:
            return found[0]
        if time.monotonic() > deadline:
            busy = f"the OAK {names} is in use by another process: end that one, or name another device"
            raise CameraError(busy if found else missing(address))
        time.sleep(_SEARCH_STEP_S)


def missing(address: str, sysfs: Path = SYSFS_USB, nodes: Path = USB_NODES) -> str:
    """Why no OAK (of this address; empty = any) can be found, as far as this machine knows, and how to fix it."""
    if _IP.match(address):
        return (
            f"no OAK answers at {address}: check that it has power (its switch port or injector must give PoE), that "
            f"this machine has an address in its network (`ping {address}`), and that no firewall stops UDP and TCP "
            "ports 11490 and 11491"
        )
    what = f"the OAK '{address}' is not connected" if address else "no OAK camera is connected"
    boards: list[str] = []
    for vendor in sorted(sysfs.glob("*/idVendor")):
        with suppress(OSError, ValueError):  # it has been unplugged meanwhile
            if vendor.read_text().strip() == USB_VENDOR:
                bus, device = (int((vendor.parent / name).read_text()) for name in ("busnum", "devnum"))
                node = nodes / f"{bus:03d}" / f"{device:03d}"
                boards.append(f"{node}" if os.access(node, os.W_OK) else f"{node}, which this user may not open")
    there = f", though there is one on USB ({'; '.join(boards)})" if boards else ""
    return (
        f"{what}{there}: plug it in again, with its own cable, into a USB 3 port (PoE: `device` may be its IP address, "
        "which also works through a router); `semantic-mapper doctor --cameras` shows those that answer. Without "
        f"permission it does not show either: {UDEV_RULE}"
    )


def _search(address: str = "") -> list[Any]:
    """Raises CameraError: DepthAI cannot search."""
    dai = load_depthai()
    try:
        if not address:
            return list(dai.Device.getAllConnectedDevices())
        found, info = dai.Device.getDeviceByIdOrName(address)
    except RuntimeError as error:
        raise CameraError(f"DepthAI cannot search for cameras: {error}") from error
    return [info] if found else []


def _describe(info: Any) -> FoundCamera:
    state = info.state.name.removeprefix("X_LINK_").lower().replace("_", " ")
    notes = [f"{info.protocol.name.removeprefix('X_LINK_').lower().replace('_', '/')} {info.name}", state]
    if info.state.name in _BUSY:
        notes.append("another process has it")
    if "PERMISSION" in info.status.name:
        notes.append(f"no permission: {UDEV_RULE}")
    name = info.getDeviceId() or info.name  # not every state gives the id
    return FoundCamera(kind="oak", name=name, address=name, note=", ".join(notes))
