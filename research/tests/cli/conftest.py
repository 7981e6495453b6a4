"""Tiny weights and settings for tests of the command."""

from tests.nodes.conftest import config, folder, weights

__all__ = ["config", "folder", "weights"]
