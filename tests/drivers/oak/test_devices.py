from __future__ import annotations

import os
import re
import signal
from pathlib import Path

import depthai as dai
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.drivers import oak
from semantic_mapper.drivers.oak import devices
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import CameraError, ConfigError

NOWHERE = "192.0.2.1"  # an address that no machine has
NOBODY = "FFFFFFFFFFFFFFFF"


def usb_board(folder: Path, vendor: str = devices.USB_VENDOR) -> tuple[Path, Path]:
    """What the kernel shows of a board on USB: its entry, and its device file."""
    entry, node = folder / "sys" / "1-2", folder / "dev" / "003" / "017"
    entry.mkdir(parents=True)
    node.parent.mkdir(parents=True)
    for name, text in (("idVendor", vendor), ("busnum", "3"), ("devnum", "17")):
        (entry / name).write_text(text + "\n")
    node.touch()
    return folder / "sys", folder / "dev"


def info(state: str, status: str = "X_LINK_SUCCESS") -> dai.DeviceInfo:
    return dai.DeviceInfo(
        "3.17",
        "18443010D1",
        getattr(dai.XLinkDeviceState, state),
        dai.XLinkProtocol.X_LINK_USB_VSC,
        dai.XLinkPlatform.X_LINK_MYRIAD_X,
        getattr(dai.XLinkError_t, status),
    )


def found(monkeypatch: pytest.MonkeyPatch, *infos: dai.DeviceInfo) -> None:
    """Let DepthAI find these: the one thing that takes real devices."""
    monkeypatch.setattr(dai.Device, "getAllConnectedDevices", staticmethod(lambda: list(infos)))


def test_a_device_is_listed_by_what_opens_it(monkeypatch: pytest.MonkeyPatch) -> None:
    found(monkeypatch, info("X_LINK_UNBOOTED"))
    assert oak.list_devices() == [FoundCamera("oak", "18443010D1", "18443010D1", "usb/vsc 3.17, unbooted")]


def test_the_only_device_needs_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    found(monkeypatch, info("X_LINK_UNBOOTED"))
    assert devices.find_device("", 0.1).getDeviceId() == "18443010D1"
    found(monkeypatch, info("X_LINK_UNBOOTED"), info("X_LINK_UNBOOTED"))
    with pytest.raises(CameraError, match=r"several OAK cameras are connected: 18443010D1 \(3\.17\)"):
        devices.find_device("", 0.1)
    found(monkeypatch, info("X_LINK_BOOTED"))
    with pytest.raises(CameraError, match="in use by another process"):
        devices.find_device("", 0.1)


@pytest.mark.parametrize(
    ("device", "says"),
    [(NOBODY, f"the OAK '{NOBODY}' is not connected"), (NOWHERE, f"no OAK answers at {NOWHERE}: .*PoE.*firewall")],
)
def test_a_device_that_is_not_there_is_an_error_that_helps(device: str, says: str) -> None:
    with pytest.raises(CameraError, match=says), oak.open_camera(Config(device=device), "front"):
        pass


def test_advice_follows_what_is_on_usb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = devices.missing("", tmp_path / "sys", tmp_path / "dev")
    assert "no OAK camera is connected: plug it in again" in nothing and "udevadm" in nothing
    sysfs, nodes = usb_board(tmp_path)
    assert "though there is one on USB" in devices.missing("", sysfs, nodes)
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may open anything
    locked = devices.missing(NOBODY, sysfs, nodes)
    assert f"{nodes / '003' / '017'}, which this user may not open" in locked and "udevadm" in locked


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"widht": 640}, "did you mean `width`"),
        ({"width": 650}, "multiple of 16"),
        ({"fps": 0}, ">= 0.01"),
        ({"rgb": "RGB"}, "'RGB' is not valid"),
        ({"odometry": True, "depth": False}, "odometry needs the stereo pair"),
        ({"left": "CAM_C"}, "left and right are the same"),
    ],
)
def test_a_wrong_configuration_is_refused(data: dict, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        convert_config(data, Config, "oak.toml")


def test_signals_stay_as_they_are() -> None:
    """DepthAI's own handler would kill the process where a disk is full or a file as large as it may get (SIGXFSZ)."""
    for signum in (signal.SIGXFSZ, signal.SIGSEGV, signal.SIGTERM):
        bit = 1 << (signum - 1)
        status = Path("/proc/self/status").read_text(encoding="ascii")
        caught, ignored = (int(re.search(rf"{name}:\s*(\w+)", status)[1], 16) & bit for name in ("SigCgt", "SigIgn"))  # type: ignore[index]
        assert bool(ignored) == (signum == signal.SIGXFSZ)
        assert not caught or signum == signal.SIGSEGV, "pytest's faulthandler has that one"
