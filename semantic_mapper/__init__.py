"""Posed camera frames in, live semantic 3D map out."""

import os as _os

# OpenMP reads this once, when torch is loaded. Its threads otherwise spin for milliseconds after an operation and take
# the cores from the kernels, which run on threads of their own: a step is then several times slower.
_os.environ.setdefault("OMP_WAIT_POLICY", "passive")

__version__ = "0.1.0"
