"""The log: write, read, recover, play."""

from pathlib import Path

import semantic_mapper


def demo_log() -> Path:
    """24 frames (320x240, depth, classes) of a furnished room, rendered with the noise of a depth camera."""
    return Path(semantic_mapper.__file__).parent / "demo.mcap"
