"""Two runs of one log, compared."""
