"""Work on many machines, through Ray."""
