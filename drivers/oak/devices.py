"""DepthAI, which OAK cameras are connected, and why one cannot be had."""

import functools
import importlib
import os
from typing import Any

from semantic_mapper.drivers import registry
from semantic_mapper.drivers.base import as_camera_error
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import DependencyError

UDEV_RULE = (
    """echo 'SUBSYSTEM=="usb", ATTRS{idVendor}=="03e7", MODE="0666"' | sudo tee /etc/udev/rules.d/80-movidius.rules """
    "&& sudo udevadm control --reload-rules && sudo udevadm trigger"
)
_BUSY = ("X_LINK_BOOTED", "X_LINK_GATE_BOOTED")
_FIX = (
    "end the program that uses it, or plug it in again, with its own cable, into a USB 3 port. PoE: check that its "
    "switch port gives power, that this machine has an address in its network, and that no firewall stops UDP and TCP "
    "ports 11490 and 11491; `device` may be its IP address, which also works through a router. `semantic-mapper doctor "
    f"--cameras` shows those that answer. Without permission on USB it does not show either: {UDEV_RULE}"
)


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


def find_device(address: str) -> Any:
    """DepthAI's ``DeviceInfo`` by id, IP address or USB path; empty for the only one that is connected and free.

    Raises CameraError: no camera, or several.
    """

    def free() -> dict[str, Any]:
        return {f"{d.getDeviceId()} ({d.name})": d for d in _search(address) if d.state.name not in _BUSY}

    return registry.find_device(free, "OAK", address, _FIX)


def _search(address: str = "") -> list[Any]:
    dai = load_depthai()
    with as_camera_error("DepthAI cannot search for cameras", "is the USB bus in order?", RuntimeError):
        if not address:
            return list(dai.Device.getAllConnectedDevices())
        found, info = dai.Device.getDeviceByIdOrName(address)
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
