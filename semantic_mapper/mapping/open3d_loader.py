"""The one file that imports Open3D. Its wheel links ``libusb-1.0``, ``libGL`` and others without shipping them; loaded
here with RTLD_GLOBAL, they need not be installed system-wide."""

import ctypes
import functools
import importlib
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from semantic_mapper.errors import DependencyError
from semantic_mapper.log_events import get_logger
from semantic_mapper.memory import is_out_of_memory, memory_message

SYSTEM_PACKAGES = "libgl1 libegl1 libx11-6 libgomp1"  # of Debian and Ubuntu, which its wheel needs
_log = get_logger(__name__)


@functools.cache
def load_open3d() -> Any:
    """Import Open3D once and return the module, quiet; ``DependencyError`` says which library is missing."""
    notes = preload_libraries()
    try:
        open3d = importlib.import_module("open3d")
    except (ImportError, OSError, MemoryError) as error:
        if is_out_of_memory(error):
            raise DependencyError(f"Open3D cannot be loaded: {memory_message(error)}") from error
        raise DependencyError(
            f"Open3D cannot be loaded: {error}. Install what is missing: `apt-get install {SYSTEM_PACKAGES}` (Debian, "
            "Ubuntu), or run `make setup` in a checkout; glibc 2.35 or newer is needed."
            + "".join(f" [{note}]" for note in notes)
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    _log.debug("open3d_loaded", version=open3d.__version__, preload_failures=notes)
    return open3d


def open3d_version() -> str:
    """Version of the installed package. Raises PackageNotFoundError: it is not installed."""
    try:
        return metadata.version("open3d")
    except metadata.PackageNotFoundError:
        return metadata.version("open3d-cpu")  # its build without CUDA


def preload_libraries() -> list[str]:
    """Load libusb and what ``make setup`` has put into ``syslibs`` into the process, in whatever order their links ask
    for; a line for each that cannot be loaded."""
    folder = Path(sys.prefix) / "syslibs"
    waiting = _libusb() + sorted(p for p in folder.rglob("*.so*") if p.is_file())
    failures: dict[Path, str] = {}
    while waiting:
        failures = {}
        for path in waiting:
            try:
                ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
            except OSError as error:
                failures[path] = f"{path.name}: {error}"
        if len(failures) == len(waiting):  # no progress in a whole round: what is left cannot be loaded
            break
        waiting = list(failures)
    return list(failures.values())


def _libusb() -> list[Path]:
    """``libusb-1.0`` of its package, where there is one for this platform."""
    try:
        path = importlib.import_module("libusb_package").get_library_path()
    except ImportError:
        return []
    return [] if path is None else [Path(path)]
