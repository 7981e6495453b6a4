"""The map and the field seen from a pose."""
