"""Posed camera frames in, live semantic 3D map out."""

import os as _os
import sys as _sys

# OpenMP reads this once, when torch is loaded. Its threads otherwise spin for milliseconds after an operation and take
# the cores from the kernels, which run on threads of their own. `threads` mends it where torch was loaded before.
SPINNING_THREADS = "torch" in _sys.modules and "OMP_WAIT_POLICY" not in _os.environ
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
