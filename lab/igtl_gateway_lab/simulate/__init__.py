"""Synthetic sources of messages, for demonstrations and tests.  Nothing here comes from a patient."""
