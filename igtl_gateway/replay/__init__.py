"""Replay: entries out of a session file, paced, selected, verified."""
