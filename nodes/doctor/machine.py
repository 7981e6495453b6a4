"""Examinations of the machine. Each gives one line; none changes anything."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.memory import is_out_of_memory
from semantic_mapper.nodes.doctor import launch_file as doctor_launch
from semantic_mapper.nodes.doctor.check import Check
from semantic_mapper.nodes.process import usable_cores
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

PROBE_TIMEOUT_S = 180.0  # a cold disk takes long to give Open3D's 400 MB
DISK_GB = 2.0
MEMORY_GB = 3.0


def examine(launch: Path | None = None, settings: Sequence[str] = ()) -> list[Check]:
    """All examinations, in the order of how much depends on them.

    Args:
        launch: A launch file, to be examined, too.
        settings: For it, as of ``load_launch``.
    """
    checks: list[Check] = []
    own = (_python, _libc, _packages, _libusb, _open3d, _torch, _weights, _sockets, _curve, _machine, _disk)
    for check in (*own, doctor_launch.own_keys):
        checks.extend(check())
    if launch is not None:
        checks.extend(doctor_launch.launch_file(launch, settings))
    return checks


def _python() -> Iterator[Check]:
    found = f"{platform.python_version()} at {sys.executable}"
    good = sys.version_info >= (3, 11)
    yield Check("Python", "ok" if good else "bad", found, "" if good else "make setup PYTHON=python3.11 (or newer)")


def _libc() -> Iterator[Check]:
    name, version = platform.libc_ver()
    if name != "glibc":
        yield Check("C library", "bad", name or "unknown", "Open3D's wheels need glibc 2.35 or newer")
        return
    good = Version(version) >= Version("2.35")
    yield Check("C library", "ok" if good else "bad", f"glibc {version}", "" if good else "Open3D needs glibc 2.35")


def _packages() -> Iterator[Check]:
    missing, other, found = [], [], []
    for requirement in map(Requirement, metadata.requires("semantic-mapper") or ()):
        name = requirement.name
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue  # of an extra, or for another platform
        try:
            version = metadata.version(name)
            found.append(f"{name} {version}")
            if not requirement.specifier.contains(version, prereleases=True):
                other.append(f"{name} {version}, not {requirement.specifier}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        yield Check("packages", "bad", f"missing: {', '.join(missing)}", "make setup")
    if other:
        yield Check("packages", "bad", "; ".join(other), "make setup")
    if not missing and not other:
        yield Check("packages", "ok", ", ".join(found))


def _libusb() -> Iterator[Check]:
    if importlib.util.find_spec("libusb_package") is None:
        yield Check("libusb", "bad", "package libusb-package is missing", "make setup")
        return
    import libusb_package

    path = libusb_package.get_library_path()
    if path is None:
        yield Check("libusb", "bad", "no library for this platform", "apt-get install libusb-1.0-0")
    else:
        yield Check("libusb", "ok", Path(path).name)


def _open3d() -> Iterator[Check]:
    """In a process of its own: a broken library may end a process instead of raising."""
    code = "from semantic_mapper.mapping.open3d_loader import load_open3d as l; print(l().__version__)"
    try:
        done = subprocess.run(
            [sys.executable, "-I", "-c", code], capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        yield Check("Open3D", "bad", f"did not load within {PROBE_TIMEOUT_S:g} s", "is the disk very slow?")
        return
    if done.returncode == 0:
        words = done.stdout.split()  # the version comes last: loading it may print, too
        yield Check("Open3D", "ok", f"{words[-1]} loads" if words else "loads")
        return
    ended = f"ended by {signal.Signals(-done.returncode).name}" if done.returncode < 0 else ""
    last = done.stderr.strip().splitlines()[-1:] or [ended]
    yield Check("Open3D", "bad", last[0], "make setup (fetches missing system libraries into .venv/syslibs)")


def _torch() -> Iterator[Check]:
    try:
        import torch
    except ImportError as error:
        if is_out_of_memory(error):  # all that follows would fail, too
            raise
        yield Check("torch", "bad", str(error), "make setup")
        return
    yield Check("torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} threads")
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        yield Check("GPU", "ok", ", ".join(names))
    else:
        yield Check("GPU", "note", "none that torch can use; mapping runs on the CPU")


def _weights() -> Iterator[Check]:
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint

    path = default_checkpoint_path()
    try:
        checkpoint = load_checkpoint(path)
    except SemanticMapperError as error:
        yield Check("weights", "bad", str(error), "install the package again, or give --weights to each command")
        return
    size = f"{path.stat().st_size / 1e6:.1f} MB"
    yield Check("weights", "ok", f"{path.name}: {len(checkpoint.label_set)} classes, {size}")


def _sockets() -> Iterator[Check]:
    """Really send something, the way the nodes do."""
    try:
        endpoint = default_endpoint(f"doctor-{os.getpid()}")
        with Publisher(endpoint) as publisher, LosslessSubscriber(endpoint, ("status",)) as subscriber:
            publisher.wait_for_subscribers("status", timeout_s=5.0)
            publisher.publish(encode(Status("doctor", "running", 0)))
            heard = subscriber.receive(5.0)
    except SemanticMapperError as error:
        yield Check("sockets", "bad", str(error), "set XDG_RUNTIME_DIR to a folder that you may write to")
        return
    folder = Path(endpoint.removeprefix("ipc://"))
    for left in (folder, folder.with_name(folder.name + ".lock")):
        left.unlink(missing_ok=True)
    if heard is None:
        yield Check("sockets", "bad", f"nothing arrives through {endpoint}", "is the folder on a network disk?")
    else:
        yield Check("sockets", "ok", f"ipc in {folder.parent}")


def _curve() -> Iterator[Check]:
    import zmq

    if zmq.has("curve"):
        yield Check("encryption", "ok", f"CURVE, libzmq {zmq.zmq_version()}")
    else:
        yield Check("encryption", "note", "this libzmq has no CURVE", "install the pyzmq wheel from the package index")


def _machine() -> Iterator[Check]:
    yield Check("CPU", "ok", f"{usable_cores()} cores, {platform.machine()}")
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    small = total < MEMORY_GB
    fix = "use a larger --voxel-size" if small else ""
    yield Check("memory", "note" if small else "ok", f"{total:.1f} GB, {free:.1f} GB free", fix)


def _disk() -> Iterator[Check]:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    writable = os.access(Path.cwd(), os.W_OK)
    if free < DISK_GB:
        yield Check("disk", "bad", f"{free:.1f} GB free here", "free some space; logs and maps take gigabytes")
    else:
        fix = "" if writable else "give --out with a folder that you may write to"
        yield Check(
            "disk",
            "ok" if writable else "note",
            f"{free:.0f} GB free here{'' if writable else ', but not writable'}",
            fix,
        )
