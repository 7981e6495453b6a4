"""Checks of the V4L2 driver in a virtual machine with the kernel's virtual camera; see ``v4l2_machine.py``.

No pytest and no torch: importing them over the shared file system would take longer than all checks. This is no module
of the default test run; it needs a ``/dev/video0`` of ``vivid``.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
import types
from collections.abc import Callable
from itertools import islice, pairwise
from pathlib import Path

sys.modules["torch"] = types.ModuleType("torch")  # the library names its types, the driver computes nothing with it

from semantic_mapper.drivers.base import Camera  # noqa: E402
from semantic_mapper.drivers.registry import find_cameras, open_camera  # noqa: E402
from semantic_mapper.drivers.v4l2 import devices, ioctls  # noqa: E402
from semantic_mapper.errors import CameraError  # noqa: E402

DRIVER = Path("/sys/bus/platform/drivers/vivid")
LINKS = Path("/dev/v4l/by-id")
LINK = LINKS / "platform-vivid-video-index0"
SCRATCH = Path("/dev/shm")
SIZE = (640, 480)


def _link_camera() -> Path:
    """What udev does: the camera's name leads to where it is now."""
    LINKS.mkdir(parents=True, exist_ok=True)
    LINK.unlink(missing_ok=True)
    node = devices.video_nodes()[-1]
    LINK.symlink_to(node)
    return node


def _calibration(width: int = SIZE[0], height: int = SIZE[1]) -> str:
    path = SCRATCH / f"{width}.toml"
    path.write_text(
        f"fx = 600\nfy = 600\ncx = {width / 2}\ncy = {height / 2}\nwidth = {width}\nheight = {height}\n"
        "distortion = [-0.2, 0.05, 0.0, 0.0]\n"
    )
    return str(path)


def _vivid(**settings: object) -> Camera:
    config = {"device": str(LINK), "calibration": _calibration(), "fourcc": "YUYV", "fps": 25.0, "stall_s": 1.0}
    return open_camera("v4l2", config | settings, "front", "guest")


def _press(name: str, value: int = 1) -> None:
    """Set a control of vivid beside whoever streams."""
    with ioctls.opened(LINK) as fd:
        ioctls.set_control(fd, ioctls.list_controls(fd)[name].id, value)


def _until(holds: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def _check_listing() -> None:
    found, _ = find_cameras(("v4l2",))
    assert [(c.name, c.address) for c in found] == [("vivid", str(LINK))], found
    assert "YUYV" in found[0].note and "platform:vivid" in found[0].note, found


def _check_images_and_stamps() -> None:
    with _vivid() as camera:
        images = list(islice(camera, 20))
        ages = [time.monotonic_ns() - images[-1].stamp_ns]
        assert camera.warnings == (), camera.warnings
        assert camera.info.frame_hz == 25, camera.info
    assert all(i.rgb.shape == (480, 640, 3) for i in images)
    assert images[-1].rgb.std() > 30  # a test picture, not nothing
    steps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(images)]
    jumps = [b.seq - a.seq for a, b in pairwise(images)]
    per_image = [step / jump / 1e6 for step, jump in zip(steps, jumps, strict=True)]
    print("ms between images by the kernel's stamps:", [round(v, 2) for v in per_image], "age ms:", ages[0] / 1e6)
    assert min(steps) > 0 and min(jumps) > 0 and 0 < ages[0] < 5e9  # an emulated processor is slow
    assert images[0].intrinsics.distortion == ()


def _check_what_it_cannot_do_is_told() -> None:
    with _vivid(fourcc="MJPG") as camera:
        next(iter(camera))
        print(camera.warnings)
        assert any("requested pixels as MJPG, it gives" in t for t in camera.warnings)
    refused = ""
    try:
        with _vivid(calibration=_calibration(650, 490)):
            pass
    except CameraError as error:
        refused = str(error)
    assert "was calibrated at 650x490" in refused, refused


def _check_controls() -> None:
    with _vivid(gain=42, controls={"brightness": 99, "contrst": 3}, exposure_ms=5.0) as camera:
        told = camera.warnings
    print(told)
    assert len(told) == 2 and "did you mean 'contrast'" in told[1] and "no control for exposure_ms" in told[0], told
    with ioctls.opened(LINK) as fd:
        controls = ioctls.list_controls(fd)
        assert ioctls.get_control(fd, controls["brightness"].id) == 99
        assert ioctls.get_control(fd, controls["gain"].id) == 42


def _check_dropped_buffers_are_no_end() -> None:
    with _vivid() as camera:
        images = iter(camera)
        next(images)
        _press("percentage_of_dropped_buffers", 60)
        later = list(islice(images, 10))
        _press("percentage_of_dropped_buffers", 0)
        steps = [(b.stamp_ns - a.stamp_ns) / 1e6 for a, b in pairwise(later)]
        print("ms between images with 60 % dropped:", [round(s) for s in steps])
        assert max(steps) > 70 and camera.warnings == ()


def _check_a_stalled_stream_is_told_and_comes_back() -> None:
    with _vivid() as camera:
        images = iter(camera)
        first = next(images)
        _press("percentage_of_dropped_buffers", 100)
        _until(lambda: any("stalled" in t or "no images" in t for t in camera.warnings), str(camera.warnings))
        print(camera.warnings)
        _press("percentage_of_dropped_buffers", 0)
        going_ns = time.monotonic_ns()
        after = next(i for i in images if i.stamp_ns > going_ns)
        print("stalled; images again after s:", (after.stamp_ns - going_ns) / 1e9)
        assert after.seq > first.seq, "the count goes on"
        _until(lambda: camera.warnings == (), str(camera.warnings))


def _check_unplugged_and_back_under_another_index() -> None:
    before = LINK.resolve()
    with _vivid() as camera:
        images = iter(camera)
        first = next(images)
        holder = os.open(before, os.O_RDONLY)  # its number stays taken
        (DRIVER / "unbind").write_text("vivid.0")  # while it streams
        LINK.unlink()
        _until(lambda: any("waited for since" in t for t in camera.warnings), str(camera.warnings))
        print(camera.warnings)
        (DRIVER / "bind").write_text("vivid.0")
        _until(lambda: bool(devices.video_nodes()), "no node")
        node = _link_camera()
        back_ns = time.monotonic_ns()
        after = next(i for i in images if i.stamp_ns > back_ns)
        os.close(holder)
        print(f"was {before}, is {node}; images after s:", (time.monotonic_ns() - back_ns) / 1e9)
        assert node != before
        assert after.seq > first.seq, "the count goes on"
        _until(lambda: camera.warnings == (), str(camera.warnings))


def _check_the_disconnect_control() -> None:
    with _vivid() as camera:
        images = iter(camera)
        next(images)
        _press("disconnect")
        LINK.unlink()
        _until(lambda: any("waited for since" in t for t in camera.warnings), str(camera.warnings))
        (DRIVER / "unbind").write_text("vivid.0")
        (DRIVER / "bind").write_text("vivid.0")
        _until(lambda: bool(devices.video_nodes()), "no node")
        _link_camera()
        back_ns = time.monotonic_ns()
        next(i for i in images if i.stamp_ns > back_ns)


def main() -> int:
    """0 where all checks hold."""
    _link_camera()
    failed = 0
    checks = [f for name, f in globals().items() if name.startswith("_check_")]
    for check in checks:
        began = time.monotonic()
        try:
            check()
            print(f"PASS {check.__name__[7:].replace('_', ' ')} ({time.monotonic() - began:.1f} s)", flush=True)
        except Exception:  # noqa: BLE001 - told, and counted
            failed += 1
            print(f"FAIL {check.__name__[7:].replace('_', ' ')}\n{traceback.format_exc()}", flush=True)
    print(f"{len(checks) - failed} passed, {failed} failed", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
