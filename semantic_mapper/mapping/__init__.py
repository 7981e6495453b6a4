"""Keyframes, fusion and the pipeline."""
