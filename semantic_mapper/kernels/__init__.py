"""Compiled loops in C, and how Python calls them."""

from semantic_mapper.kernels.binding import kernel, parallel_kernel, processor_flags

__all__ = ["kernel", "parallel_kernel", "processor_flags"]
