"""Other mappers and odometries, measured beside ours on one log."""
