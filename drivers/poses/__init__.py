"""Where a camera was: told by itself, a topic, a board, its own depth or pictures; or it never moves."""
