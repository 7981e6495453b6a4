"""The one place that imports DepthAI, when a device is looked for or opened."""

from __future__ import annotations

import functools
import importlib
import os
from typing import Any

from semantic_mapper.errors import DependencyError


@functools.cache
def load_depthai() -> Any:
    """Import DepthAI once and return the module.

    Raises:
        DependencyError: it cannot be loaded, and how to get it.
    """
    # Its handler of signals would end the process where writing to a full disk is an error to be told (SIGXFSZ), and
    # print a trace of its own in the place of Python's. Who wants it sets the variable to 1.
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    # A robot does not report to its maker unless it is instructed to, and leaves no files for that in its working
    # folder.
    os.environ.setdefault("DEPTHAI_TELEMETRY", "0")
    os.environ.setdefault("DEPTHAI_DISABLE_STARTUP_NOTIFICATIONS", "1")
    try:
        return importlib.import_module("depthai")
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"DepthAI cannot be loaded: {error}. Run `make setup`, or install it yourself: "
            "pip install 'depthai>=3.12,<4'"
        ) from error
