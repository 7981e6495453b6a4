"""The RealSense SDK, which cameras are connected, and why one cannot be had."""

from __future__ import annotations

import functools
import importlib
import sys
import time
from pathlib import Path
from typing import Any

from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import CameraError, DependencyError
from semantic_mapper.mapping.open3d_loader import preload_folder, preload_libusb

USB_VENDOR = "8086"
UDEV_RULE = f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{USB_VENDOR}", MODE="0666"'
_SEARCH_STEP_S = 0.2
_FIX = (
    "check its cable (a USB 3 port, `lsusb` shows it as Intel or RealSense); without permission it does not show "
    f"either: echo '{UDEV_RULE}' | sudo tee /etc/udev/rules.d/99-realsense.rules && sudo udevadm control "
    "--reload-rules && sudo udevadm trigger, then plug it in again"
)


@functools.cache
def load_realsense() -> Any:
    """Import ``pyrealsense2`` once and return the module; ``DependencyError`` where it cannot be loaded."""
    notes = preload_libusb() + preload_folder(Path(sys.prefix) / "syslibs")  # the wheel links libusb, and has none
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


def find_device(serial: str, search_s: float) -> Any:
    """The SDK's ``device`` of a serial number, looked for until it is there; empty for the only one that is connected.

    Raises CameraError: there is no device, or several where one should be; and how to fix it.
    """
    deadline = time.monotonic() + search_s
    while True:
        devices = {about(device, "serial_number"): device for device in connected()}
        fitting = [device for number, device in devices.items() if serial in ("", number)]
        if len(fitting) == 1:
            return fitting[0]
        if len(fitting) > 1:
            raise CameraError(f"several RealSense cameras are connected: {', '.join(devices)}; say which by `device`")
        if time.monotonic() > deadline:
            what = f"the RealSense '{serial}' is not connected" if serial else "no RealSense camera is connected"
            there = f" (there is {', '.join(devices)})" if devices else ""
            raise CameraError(f"{what}{there}: {_FIX}")
        time.sleep(_SEARCH_STEP_S)


def connected() -> list[Any]:
    """The SDK's ``device`` of each camera; ``CameraError`` where it cannot search."""
    try:
        return list(load_realsense().context().query_devices())
    except RuntimeError as error:
        raise CameraError(f"the RealSense SDK cannot search for cameras: {error}") from error


def about(device: Any, what: str) -> str:
    """What a device says of itself (a ``camera_info`` by name); empty where it says nothing."""
    name = getattr(load_realsense().camera_info, what)
    return str(device.get_info(name)) if device.supports(name) else ""
