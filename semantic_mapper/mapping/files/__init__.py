"""Maps in files: saved, merged, exported."""
