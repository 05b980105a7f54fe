"""What happens to recordings after they are closed: ``retention`` deletes old ones, ``upload`` copies them to a store.

``stored`` finds the recordings in a folder by their contents, for both.
"""
