"""Benchmark protocols: which views of which rooms are rendered from what, and how the figures come about."""
