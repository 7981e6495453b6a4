"""The RealSense SDK, which cameras are connected, and why one cannot be had."""

import functools
import importlib
from typing import Any

from semantic_mapper.drivers import registry
from semantic_mapper.drivers.base import as_camera_error
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import DependencyError
from semantic_mapper.mapping.open3d_loader import preload_libraries

UDEV_RULE = 'SUBSYSTEM=="usb", ATTRS{idVendor}=="8086", MODE="0666"'
_FIX = (
    "check its cable (a USB 3 port, `lsusb` shows it as Intel or RealSense); without permission it does not show "
    f"either: echo '{UDEV_RULE}' | sudo tee /etc/udev/rules.d/99-realsense.rules && sudo udevadm control "
    "--reload-rules && sudo udevadm trigger, then plug it in again"
)


@functools.cache
def load_realsense() -> Any:
    """Import ``pyrealsense2`` once and return the module; ``DependencyError`` where it cannot be loaded."""
    notes = preload_libraries()  # the wheel links libusb, and has none
    try:
        return importlib.import_module("pyrealsense2")
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"the RealSense SDK cannot be loaded: {error}. Install it: pip install 'semantic-mapper[realsense]' (there "
            "are wheels for Linux on x86-64; elsewhere build librealsense with its Python wrapper)"
            + "".join(f" [{note}]" for note in notes)
        ) from error


def list_devices() -> list[FoundCamera]:
    """RealSense cameras of this machine."""
    found: list[FoundCamera] = []
    for device in connected():
        usb, firmware = about(device, "usb_type_descriptor"), about(device, "firmware_version")
        notes = [f"USB {usb}"] * bool(usb) + [f"firmware {firmware}"] * bool(firmware)
        serial = about(device, "serial_number")
        found.append(FoundCamera("realsense", about(device, "name"), serial, ", ".join(notes)))
    return found


def find_device(serial: str) -> Any:
    """The SDK's ``device`` of a serial number; empty for the only one that is connected.

    Raises CameraError: no camera, or several.
    """

    def fitting() -> dict[str, Any]:
        return {number: d for d in connected() if serial in ("", number := about(d, "serial_number"))}

    return registry.find_device(fitting, "RealSense", serial, _FIX)


def connected() -> list[Any]:
    """The SDK's ``device`` of each camera; ``CameraError`` where it cannot search."""
    with as_camera_error("the RealSense SDK cannot search for cameras", "is the USB bus in order?", RuntimeError):
        return list(load_realsense().context().query_devices())


def about(device: Any, what: str) -> str:
    """What a device says of itself (a ``camera_info`` by name); empty where it says nothing."""
    name = getattr(load_realsense().camera_info, what)
    return str(device.get_info(name)) if device.supports(name) else ""
