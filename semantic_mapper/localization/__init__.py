"""Where a camera is in a map that is there already."""
