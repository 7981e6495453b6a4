"""The log: write, read, recover, play."""
