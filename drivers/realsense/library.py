"""The one place that imports the RealSense SDK, when a device is looked for or opened."""

from __future__ import annotations

import functools
import importlib
import sys
from pathlib import Path
from typing import Any

from semantic_mapper.errors import DependencyError
from semantic_mapper.mapping.open3d_loader import preload_folder, preload_libusb


@functools.cache
def load_realsense() -> Any:
    """Import ``pyrealsense2`` once and return the module.

    Raises:
        DependencyError: it cannot be loaded, and how to get it.
    """
    notes = preload_libusb() + preload_folder(Path(sys.prefix) / "syslibs")  # the wheel links libusb, and has none
    try:
        return importlib.import_module("pyrealsense2")
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"the RealSense SDK cannot be loaded: {error}. Install it: pip install 'semantic-mapper[realsense]' (there "
            "are wheels for Linux on x86-64; elsewhere build librealsense with its Python wrapper)"
            + "".join(f" [{note}]" for note in notes)
        ) from error
