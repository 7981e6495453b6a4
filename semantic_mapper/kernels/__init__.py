"""Compiled loops in C, and how Python calls them."""

from semantic_mapper.kernels.binding import kernel
from semantic_mapper.kernels.threads import parallel_kernel

__all__ = ["kernel", "parallel_kernel"]
