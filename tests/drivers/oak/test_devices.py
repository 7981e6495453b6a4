import re
import signal
import subprocess
import sys

import depthai as dai
import pytest

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.oak import devices
from semantic_mapper.drivers.oak.camera import open_camera
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import CameraError, ConfigError


def info(state: str, name: str = "3.17") -> dai.DeviceInfo:
    return dai.DeviceInfo(
        name,
        "18443010D1",
        getattr(dai.XLinkDeviceState, state),
        dai.XLinkProtocol.X_LINK_USB_VSC,
        dai.XLinkPlatform.X_LINK_MYRIAD_X,
        dai.XLinkError_t.X_LINK_SUCCESS,
    )


def found(monkeypatch: pytest.MonkeyPatch, *infos: dai.DeviceInfo) -> None:
    """Let DepthAI find these: the one thing that takes real devices."""
    monkeypatch.setattr(dai.Device, "getAllConnectedDevices", staticmethod(lambda: list(infos)))


def test_devices_are_listed_and_the_only_free_one_needs_no_name(monkeypatch: pytest.MonkeyPatch) -> None:
    found(monkeypatch, info("X_LINK_UNBOOTED"))
    assert devices.list_devices() == [FoundCamera("oak", "18443010D1", "18443010D1", "usb/vsc 3.17, unbooted")]
    assert devices.find_device("").getDeviceId() == "18443010D1"
    found(monkeypatch, info("X_LINK_UNBOOTED"), info("X_LINK_UNBOOTED", name="3.18"))
    with pytest.raises(CameraError, match=r"several OAK cameras are connected: 18443010D1 \(3\.17\), 18443010D1"):
        devices.find_device("")
    found(monkeypatch, info("X_LINK_BOOTED"))
    with pytest.raises(CameraError, match="no OAK camera is connected, or it is in use: end the program that uses it"):
        devices.find_device("")


@pytest.mark.parametrize("device", ["192.0.2.1", "FFFFFFFFFFFFFFFF"])  # an address and an id that nothing has
def test_a_device_that_is_not_there_is_an_error_that_helps(device: str) -> None:
    says = f"the OAK '{device}' is not connected.*PoE.*firewall.*udevadm"
    with pytest.raises(CameraError, match=says), open_camera(Config(device=device), "front"):
        pass


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
    code = "from semantic_mapper.drivers.oak.devices import load_depthai; load_depthai()"
    code += "; print(open('/proc/self/status').read())"  # in a new process: other libraries catch signals, too
    status = subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True).stdout
    for signum in (signal.SIGXFSZ, signal.SIGSEGV, signal.SIGTERM):
        bit = 1 << (signum - 1)
        caught, ignored = (int(re.search(rf"{name}:\s*(\w+)", status)[1], 16) & bit for name in ("SigCgt", "SigIgn"))  # type: ignore[index]
        assert not caught and bool(ignored) == (signum == signal.SIGXFSZ)
