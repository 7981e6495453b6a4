"""Where a camera was: from itself, a topic, a board, its own depth or pictures; or it never moves."""
