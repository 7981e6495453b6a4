"""Examinations of this machine. Each finds something out; none changes anything."""

import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from semantic_mapper.errors import SemanticMapperError
from semantic_mapper.mapping.open3d_loader import SYSTEM_PACKAGES, open3d_version
from semantic_mapper.memory import is_out_of_memory
from semantic_mapper.nodes.process import usable_cores
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

PROBE_TIMEOUT_S = 180.0  # a cold disk takes long to give Open3D's 400 MB
CHECKOUT = (Path(__file__).parents[2] / "Makefile").is_file()
INSTALL = "make setup" if CHECKOUT else f"{sys.executable} -m pip install --upgrade semantic-mapper"
DISK_GB = 2.0
MEMORY_GB = 3.0


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: ``note`` = works, but worth knowing; ``bad`` = something will fail, ``fix`` says what to do."""

    name: str
    state: Literal["ok", "note", "bad"]
    found: str
    fix: str = ""


def examine() -> list[Check]:
    """All examinations, in the order of how much depends on them."""
    return [check for look in (_packages, _open3d, _torch, _weights, _sockets, _machine) for check in look()]


def _packages() -> Iterator[Check]:
    wrong: list[str] = []
    for requirement in map(Requirement, metadata.requires("semantic-mapper") or ()):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue  # of an extra, or for another platform
        name = requirement.name
        try:
            version = open3d_version() if name == "open3d" else metadata.version(name)
            if not requirement.specifier.contains(version, prereleases=True):
                wrong.append(f"{name} {version}, not {requirement.specifier}")
        except metadata.PackageNotFoundError:
            if name == "torch":  # see _torch
                continue
            wrong.append(f"{name} is missing")
    found = f"{'; '.join(wrong) or 'all that is needed'}, Python {platform.python_version()} at {sys.executable}"
    yield Check("packages", "bad" if wrong else "ok", found, INSTALL if wrong else "")


def _open3d() -> Iterator[Check]:
    """In a process of its own: a broken library may end a process instead of raising."""
    code = "from semantic_mapper.mapping.open3d_loader import load_open3d as l; print(l().__version__)"
    try:
        command = [sys.executable, "-I", "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        yield Check("Open3D", "bad", f"did not load within {PROBE_TIMEOUT_S:g} s", "is the disk very slow?")
        return
    if done.returncode == 0:
        yield Check("Open3D", "ok", f"{''.join(done.stdout.split()[-1:])} loads")  # loading it may print, too
        return
    ended = f"ended by {signal.Signals(-done.returncode).name}" if done.returncode < 0 else ""
    last = (done.stderr.strip().splitlines()[-1:] or [ended])[0].partition("DependencyError: ")
    fix = f"{'make setup' if CHECKOUT else f'apt-get install {SYSTEM_PACKAGES}'}; its wheels need glibc 2.35 or newer"
    yield Check("Open3D", "bad", (last[2] or last[0]).partition(". Install")[0], fix)


def _torch() -> Iterator[Check]:
    try:
        import torch
    except ImportError as error:
        if is_out_of_memory(error):  # all that follows would fail, too
            raise
        if isinstance(error, ModuleNotFoundError) and error.name == "torch":
            yield Check("torch", "note", "not installed; mapping needs none, learning, `refine`, `eval` and GPUs do")
            return
        yield Check("torch", "bad", str(error), INSTALL)
        return
    yield Check("torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} threads")
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        yield Check("GPU", "ok", ", ".join(names))
    else:
        yield Check("GPU", "note", "none that torch can use; mapping runs on the CPU")


def _weights() -> Iterator[Check]:
    from semantic_mapper.fields.weights import default_checkpoint_path, load_weights

    path = default_checkpoint_path()
    try:
        yield Check("weights", "ok", f"{path.name}: {len(load_weights(path).label_set)} classes")
    except SemanticMapperError as error:
        yield Check("weights", "bad", str(error), "install the package again, or give --weights to each command")


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


def _machine() -> Iterator[Check]:
    yield Check("CPU", "ok", f"{usable_cores()} cores, {platform.machine()}")
    pages, total_pages = os.sysconf("SC_AVPHYS_PAGES"), os.sysconf("SC_PHYS_PAGES")
    free, total = (count * os.sysconf("SC_PAGE_SIZE") / 1e9 for count in (pages, total_pages))
    small = total < MEMORY_GB
    found = f"{total:.1f} GB, {free:.1f} GB free"
    yield Check("memory", "note" if small else "ok", found, "use a larger --voxel-size" if small else "")
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    full = free < DISK_GB
    fix = "free some space; logs and maps take gigabytes" if full else ""
    yield Check("disk", "bad" if full else "ok", f"{free:.1f} GB free here", fix)
