"""Examinations of this machine, and of a launch file. Each finds something out; none changes anything."""

from __future__ import annotations

import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from semantic_mapper.config import load_config, load_mapper_config
from semantic_mapper.drivers.registry import find_cameras
from semantic_mapper.errors import CameraError, ConfigError, SemanticMapperError
from semantic_mapper.memory import is_out_of_memory
from semantic_mapper.nodes.launcher.launch_file import Launch, NodeEntry, load_launch
from semantic_mapper.nodes.options import CameraOptions, FinetunerOptions, LiveCamera, MapperOptions, table_of
from semantic_mapper.nodes.process import usable_cores
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.transport.codec import encode
from semantic_mapper.transport.endpoints import default_endpoint
from semantic_mapper.transport.keys import load_keys, user_key_folder
from semantic_mapper.transport.messages import Status
from semantic_mapper.transport.sockets import LosslessSubscriber, Publisher

PROBE_TIMEOUT_S = 180.0  # a cold disk takes long to give Open3D's 400 MB
DISK_GB = 2.0
MEMORY_GB = 3.0


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: ``note`` = works, but worth knowing; ``bad`` = something will fail, ``fix`` says what to do."""

    name: str
    state: Literal["ok", "note", "bad"]
    found: str
    fix: str = ""


def examine(launch: Path | None = None, settings: Sequence[str] = ()) -> list[Check]:
    """All examinations, in the order of how much depends on them.

    Args:
        launch: A launch file, to be examined, too.
        settings: For it, as of ``load_launch``.
    """
    checks = [
        check for look in (_packages, _open3d, _torch, _weights, _sockets, _machine, own_keys) for check in look()
    ]
    return checks if launch is None else [*checks, *examine_launch(launch, settings)]


def _failed(name: str, error: SemanticMapperError) -> Check:
    """Errors say what is wrong; and after a semicolon, how to fix it."""
    found, _, fix = str(error).partition("; ")
    return Check(name, "bad", found, fix)


def _packages() -> Iterator[Check]:
    wrong: list[str] = []
    for requirement in map(Requirement, metadata.requires("semantic-mapper") or ()):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue  # of an extra, or for another platform
        try:
            version = metadata.version(requirement.name)
            if not requirement.specifier.contains(version, prereleases=True):
                wrong.append(f"{requirement.name} {version}, not {requirement.specifier}")
        except metadata.PackageNotFoundError:
            wrong.append(f"{requirement.name} is missing")
    python = f"Python {platform.python_version()} at {sys.executable}"
    if wrong:
        yield Check("packages", "bad", f"{python}: {'; '.join(wrong)}", "make setup")
    else:
        yield Check("packages", "ok", f"all that is needed, {python}")


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
        yield Check("Open3D", "ok", f"{''.join(done.stdout.split()[-1:])} loads")  # loading it may print, too
        return
    ended = f"ended by {signal.Signals(-done.returncode).name}" if done.returncode < 0 else ""
    last = done.stderr.strip().splitlines()[-1:] or [ended]
    fix = "make setup (fetches missing system libraries into .venv/syslibs); its wheels need glibc 2.35 or newer"
    yield Check("Open3D", "bad", last[0], fix)


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
    try:
        yield Check("weights", "ok", _load_weights(""))
    except SemanticMapperError as error:
        yield Check("weights", "bad", str(error), "install the package again, or give --weights to each command")


def _load_weights(named: str) -> str:
    """What these weights, or those of the package, are called.

    Raises:
        WeightsError: they cannot be used.
    """
    from semantic_mapper.fields.checkpoint import default_checkpoint_path, load_checkpoint

    path = Path(named) if named else default_checkpoint_path()
    checkpoint = load_checkpoint(path)
    return f"{path.name}, {len(checkpoint.label_set)} classes"


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
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    small = total < MEMORY_GB
    fix = "use a larger --voxel-size" if small else ""
    yield Check("memory", "note" if small else "ok", f"{total:.1f} GB, {free:.1f} GB free", fix)
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    full = free < DISK_GB
    fix = "free some space; logs and maps take gigabytes" if full else ""
    yield Check("disk", "bad" if full else "ok", f"{free:.1f} GB free here", fix)


def own_keys() -> Iterator[Check]:
    """Those of this user, where there are any."""
    folder = user_key_folder()
    if folder.exists():
        yield _keys_in(folder)
    else:
        yield Check("keys", "ok", f"none in {folder}; only what other machines are to reach needs them")


def _keys_in(folder: Path) -> Check:
    """Whether the keys of a folder, and those of all peers, can be used."""
    try:
        peers = load_keys(folder).peers()
    except SemanticMapperError as error:
        return _failed("keys", error)
    if not peers:
        return Check(
            "keys", "note", f"{folder}: no peers, so that nobody is let in", "semantic-mapper keys allow NAME KEY"
        )
    return Check("keys", "ok", f"{folder}: this machine's, and those of {', '.join(peers)}")


def examine_launch(path: Path, settings: Sequence[str] = ()) -> Iterator[Check]:
    """Whether a launch file can be started, what its nodes would refuse as they start, and the keys that it names.

    Args:
        path: Of the file.
        settings: As of ``load_launch``.
    """
    try:
        launch = load_launch(path, settings)
    except SemanticMapperError as error:
        yield _failed(path.name, error)
        return
    yield Check(path.name, "ok", f"{len(launch.nodes)} nodes: {', '.join(node.name for node in launch.nodes)}")
    folders = {launch.keys: None}
    for entry in launch.nodes:
        options = launch.options[entry.name]
        if isinstance(options, MapperOptions):
            folders[options.keys] = None
        try:
            if found := _settings(entry, launch):
                yield Check(entry.name, "ok", found)
        except SemanticMapperError as error:
            yield _failed(entry.name, error)
    for folder in filter(None, folders):
        yield _keys_in(Path(folder).expanduser())


def _settings(entry: NodeEntry, launch: Launch) -> str:
    """What was found to be right of a node's settings beyond its options; empty where it has none.

    Raises:
        SemanticMapperError: something is not.
    """
    match launch.options[entry.name]:
        case CameraOptions(camera=None, log=str(log)):
            if not Path(log).exists():
                raise ConfigError(f"{log}: no such log")
            return log
        case CameraOptions(camera=live) if live is not None:
            from semantic_mapper.nodes.camera.live import check_world, make_source  # loads GTSAM

            make_source(live)
            if entry.restart != "never":
                check_world(entry.name, live)
            return f"{_connected(live)}; its settings and poses"
        case MapperOptions() as options:
            path = Path(options.config) if options.config else None
            load_mapper_config(path, {"voxel_map.voxel_size_m": options.voxel_size_m or None})
            return f"its settings, and weights {_load_weights(options.weights)}"
        case FinetunerOptions() as options:
            if options.config:
                load_config(Path(options.config), OnlineConfig)
            return f"its settings, and weights {_load_weights(options.weights)}"
        case _:
            return ""


def _connected(live: LiveCamera) -> str:
    """The camera, by its address.

    Raises:
        CameraError: it is not there.
    """
    device = str(table_of(live.config, "camera.config")[0].get("device", ""))
    # Files and streams are named, not found; a device file has several names; an IP address may lie behind a router.
    named = live.kind == "opencv" or (live.kind == "stereo" and device and not device.startswith("/dev/"))
    if named or Path(device).is_char_device() or device.count(".") == 3:
        return f"{live.kind} {device}".rstrip()
    found, unknown = find_cameras((live.kind,))
    if live.kind in unknown:
        raise CameraError(unknown[live.kind])
    addresses = [camera.address for camera in found]
    if device in addresses or (addresses and not device):
        return f"{live.kind} {device or addresses[0]}"
    missing = f"{live.kind} {device} is not connected" if device else f"no {live.kind} camera is connected"
    there = f", there are {', '.join(addresses)}" if addresses else ""
    raise CameraError(f"camera '{live.id}': {missing}{there}; plug it in (`up` waits for it)")
