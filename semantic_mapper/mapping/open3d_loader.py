"""The one file that imports Open3D. Its wheel links ``libusb-1.0``, ``libGL`` and others without shipping them; loaded
here with RTLD_GLOBAL, they need not be installed system-wide."""

from __future__ import annotations

import ctypes
import functools
import importlib
import sys
from pathlib import Path
from typing import Any

from semantic_mapper.errors import DependencyError
from semantic_mapper.log_events import get_logger
from semantic_mapper.memory import is_out_of_memory, memory_message

_log = get_logger(__name__)


@functools.cache
def load_open3d() -> Any:
    """Import Open3D once and return the module, quiet; ``DependencyError`` says which library is missing."""
    notes = preload_libusb() + preload_folder(Path(sys.prefix) / "syslibs")
    try:
        open3d = importlib.import_module("open3d")
    except (ImportError, OSError, MemoryError) as error:
        if is_out_of_memory(error):
            raise DependencyError(f"Open3D cannot be loaded: {memory_message(error)}") from error
        raise DependencyError(
            f"Open3D cannot be loaded: {error}. Run `make setup`, or install what is missing (Debian/Ubuntu: `apt-get "
            "install libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1`; glibc 2.35 or newer is needed)."
            + "".join(f" [{note}]" for note in notes)
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    _log.debug("open3d_loaded", version=open3d.__version__, preload_failures=notes)
    return open3d


def preload_folder(folder: Path) -> list[str]:
    """Load every shared library below ``folder`` into the process, in whatever order their links ask for; one line for
    each that could not be."""
    waiting = sorted(p for p in folder.rglob("*.so*") if p.is_file()) if folder.is_dir() else []
    failures: dict[Path, str] = {}
    while waiting:
        failures = {path: reason for path in waiting if (reason := _load_global(path))}
        if len(failures) == len(waiting):  # no progress in a whole round: what is left cannot be loaded
            break
        waiting = list(failures)
    return [f"{path.name}: {reason}" for path, reason in failures.items()]


def _load_global(path: Path) -> str:
    """Empty where loaded, else the reason why not."""
    try:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except OSError as error:
        return str(error)
    return ""


def preload_libusb() -> list[str]:
    """Load the wheel's ``libusb-1.0`` into the process; one line for why it could not be, empty where it was."""
    try:
        libusb_package = importlib.import_module("libusb_package")
    except ImportError as error:
        return [f"package libusb-package: {error}"]
    path = libusb_package.get_library_path()
    if path is None:
        return ["package libusb-package carries no library for this platform"]
    reason = _load_global(Path(path))
    return [f"libusb: {reason}"] if reason else []
