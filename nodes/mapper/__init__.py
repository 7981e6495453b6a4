"""The mapper node: frames in, map out, and its queries, corrections and weights."""
