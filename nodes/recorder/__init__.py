"""The recorder node: writes what other nodes publish to a log."""
