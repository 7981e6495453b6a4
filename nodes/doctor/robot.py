"""Examinations for robots: devices and their permissions, clocks, ports and sockets, limits. Nothing is changed."""

from __future__ import annotations

import grp
import importlib.util
import os
import resource
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.nodes.doctor.check import Check
from semantic_mapper.nodes.viewer.server import DATA_PORT, WEB_PORT

DEV = Path("/dev")
UDEV_FOLDERS = (Path("/etc/udev/rules.d"), Path("/usr/lib/udev/rules.d"), Path("/lib/udev/rules.d"))
OAK_VENDOR = "03e7"  # USB id of what an OAK is before and after its start
OAK_RULE = f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{OAK_VENDOR}", MODE="0666"'
REALSENSE_VENDOR = "8086"
REALSENSE_RULE = f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{REALSENSE_VENDOR}", MODE="0666"'
# Of the launch files: poses, questions, status, updates, the remote viewer, Foxglove; of `view`: page and data.
PORTS = (5560, 5561, 5562, 5563, 5570, 8765, WEB_PORT, DATA_PORT)
LEAST_FILES = 1024
LEAST_SHM_MB = 64
TIMESYNC = Path("/run/systemd/timesync")
CLOCK_KEEPERS = (  # whom to ask, and what is there while it runs
    ("chronyd", "chronyc tracking", (Path("/run/chrony/chronyd.pid"), Path("/var/run/chronyd.pid"))),
    ("ntpd", "ntpq -p", (Path("/run/ntpd.pid"),)),
)
JUMP_WATCH_S = 0.2
JUMP_S = 0.05  # by so much a clock moves against another while it is watched only where it is set


def cameras() -> Iterator[Check]:
    """V4L2 devices and whether this user may open them."""
    nodes = sorted(DEV.glob("video*"))
    if not nodes:
        yield Check("V4L2", "note", "no /dev/video*", "plug a webcam in; in a container pass --device /dev/video0")
        return
    shut = [node for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    if not shut:
        yield Check("V4L2", "ok", f"{len(nodes)} devices, all may be opened")
        return
    group = _group_of(shut[0])
    member = "" if group is None else f"sudo usermod -aG {group} $USER, then log in again"
    yield Check("V4L2", "bad", f"no permission: {', '.join(map(str, shut))}", member or f"sudo chmod 666 {shut[0]}")


def oak() -> Iterator[Check]:
    """DepthAI's udev rule, without which an OAK on USB may be opened by root alone."""
    yield _usb_rule("OAK", OAK_VENDOR, OAK_RULE, "80-movidius.rules")


def realsense() -> Iterator[Check]:
    """Whether the RealSense SDK is installed, and its udev rule."""
    if importlib.util.find_spec("pyrealsense2") is None:
        yield Check("RealSense", "ok", "not installed; pip install 'semantic-mapper[realsense]' where there is one")
        return
    yield _usb_rule("RealSense", REALSENSE_VENDOR, REALSENSE_RULE, "99-realsense.rules")


def _usb_rule(name: str, vendor: str, rule: str, file: str) -> Check:
    """Whether this user may open USB devices of a vendor."""
    if os.geteuid() == 0:
        return Check(f"{name} on USB", "ok", "this user may open all of USB")
    for folder in UDEV_FOLDERS:
        for path in sorted(folder.glob("*.rules")) if folder.is_dir() else ():
            if f'idVendor}}=="{vendor}"' in _text(path):
                return Check(f"{name} on USB", "ok", str(path))
    mend = f"echo '{rule}' | sudo tee /etc/udev/rules.d/{file}; sudo udevadm control --reload-rules"
    return Check(f"{name} on USB", "note", "no udev rule: only root may open one", f"{mend}; then plug it in again")


def clocks() -> Iterator[Check]:
    """Whether time is synchronised with others, and whether it jumps now."""
    before = time.time() - time.monotonic()
    time.sleep(JUMP_WATCH_S)
    moved_s = time.time() - time.monotonic() - before
    if abs(moved_s) > JUMP_S:
        mend = "find out who sets it (chronyc tracking, timedatectl); images are stamped on the monotonic clock"
        yield Check("clock", "note", f"the wall clock moved by {moved_s:+.3f} s while it was watched", mend)
        return
    synchronised = _synchronised()
    if synchronised is None:
        yield Check("clock", "note", "nobody says whether the wall clock is synchronised", "apt-get install chrony")
    elif synchronised:
        yield Check("clock", "ok", f"steady, {synchronised}")
    else:
        mend = "sudo timedatectl set-ntp true; matters where poses come from another machine"
        yield Check("clock", "note", "steady, not synchronised", mend)


def ports() -> Iterator[Check]:
    """Ports of the launch files and of the viewer that somebody else has."""
    taken = [port for port in PORTS if port_is_taken(port)]
    if taken:
        text = ", ".join(map(str, taken))
        mend = f"`ss -ltnp 'sport = :{taken[0]}'` says who; give others: `up --set`, `view --port --data-port`"
        yield Check("ports", "note", f"in use: {text} (a launch or a viewer of ours, perhaps)", mend)
    else:
        yield Check("ports", "ok", f"free: {', '.join(map(str, PORTS))}")


def port_is_taken(port: int, host: str = "127.0.0.1") -> bool:
    """Whether somebody listens at a TCP port of this machine.

    Args:
        port: Its number.
        host: Where one wants to listen; other than on loopback, all interfaces count.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1" if host in ("127.0.0.1", "localhost") else "", port))
        except OSError:
            return True
    return False


def left_sockets() -> Iterator[Check]:
    """Sockets in this user's folder that nobody listens at any more."""
    from semantic_mapper.transport.endpoints import default_endpoint

    try:
        folder = Path(default_endpoint("doctor").removeprefix("ipc://")).parent
    except SemanticMapperError as error:
        yield Check("left sockets", "bad", str(error), "set XDG_RUNTIME_DIR to a folder that you may write to")
        return
    found = [path for path in sorted(folder.iterdir()) if stat.S_ISSOCK(path.lstat().st_mode)]
    stale = [path.name for path in found if not _listens(path)]
    if stale:
        yield Check("left sockets", "note", f"{', '.join(stale)} in {folder}", f"rm {folder}/{stale[0]} (harmless)")
    else:
        yield Check("left sockets", "ok", f"none in {folder}; {len(found)} in use")


def room() -> Iterator[Check]:
    """Disk where logs go by default and where maps page to, shared memory, limits of the process."""
    scratch = Path(tempfile.gettempdir())
    free_mb = shutil.disk_usage(scratch).free / 1e6
    mend = "set TMPDIR to a larger disk, or keep history.max_disk_mb and voxel_map.memory_mb small"
    small = free_mb < 1000
    yield Check(
        "scratch", "note" if small else "ok", f"{free_mb / 1e3:.1f} GB free in {scratch}", mend if small else ""
    )
    shm = Path("/dev/shm")
    shm_mb = shutil.disk_usage(shm).total / 1e6 if shm.is_dir() else 0.0
    tight = shm_mb < LEAST_SHM_MB
    mend = "in a container: --shm-size=256m; matters for training with several processes" if tight else ""
    yield Check("shared memory", "note" if tight else "ok", f"{shm_mb:.0f} MB in {shm}", mend)
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    few = files != resource.RLIM_INFINITY and files < LEAST_FILES
    text = "unlimited" if files == resource.RLIM_INFINITY else str(files)
    yield Check("open files", "note" if few else "ok", f"limit {text}", f"ulimit -n {LEAST_FILES}" if few else "")
    address = resource.getrlimit(resource.RLIMIT_AS)[0]
    if address != resource.RLIM_INFINITY:
        mend = "ulimit -v unlimited: torch and Open3D reserve far more addresses than they use"
        yield Check("address space", "note", f"limited to {address / 1e9:.1f} GB", mend)


def _group_of(path: Path) -> str | None:
    """Name of the group that a device belongs to, where that may open it; None where no group helps."""
    found = path.stat()
    if not found.st_mode & stat.S_IRGRP or found.st_gid == 0:
        return None
    try:
        return grp.getgrgid(found.st_gid).gr_name
    except KeyError:
        return None


def _text(path: Path) -> str:
    """Of a rule; empty where it cannot be read, such as behind a link to nowhere."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _synchronised() -> str | None:
    """What the services that keep the clock leave behind; empty: not synchronised; None where none of them runs."""
    if (TIMESYNC / "synchronized").exists():
        return "synchronised"
    for name, asked, files in CLOCK_KEEPERS:
        if any(os.path.exists(file) for file in files):  # not Path.exists: others may not look into their folders
            return f"{name} runs (`{asked}` says whether the clock is synchronised)"
    return "" if TIMESYNC.is_dir() else None


def _listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # busy: somebody is there
            return True
    return True
