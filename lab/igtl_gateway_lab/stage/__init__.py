"""Scenarios live: actors as programs of their own around a real bridge."""
