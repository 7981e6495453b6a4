"""Neural semantic fields: torch only."""
