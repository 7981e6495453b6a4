"""Foreign recordings into logs."""
