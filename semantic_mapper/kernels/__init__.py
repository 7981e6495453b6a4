"""Compiled loops in C, and how Python calls them."""

from semantic_mapper.kernels.binding import kernel, parallel_kernel

__all__ = ["kernel", "parallel_kernel"]
