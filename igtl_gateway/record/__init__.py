"""Recording: entries into a session file, off the hot path."""
