"""Logs: write, read, recover, import, play."""
