"""Compiled loops that draw scenes; see ``semantic_mapper.kernels``."""

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

from semantic_mapper.kernels.binding import Kernel

P = ParamSpec("P")
R = TypeVar("R")


def kernel(declaration: Callable[P, R]) -> Kernel[P, R]:
    """As ``semantic_mapper.kernels.kernel``, of the library of this folder."""
    return Kernel(declaration, folder=Path(__file__).resolve().parent / "lib")
