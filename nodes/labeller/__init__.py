"""The page on which a person labels frames of a log."""
