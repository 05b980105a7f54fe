"""Replay of recordings: playback, comparison, slices and verification."""
