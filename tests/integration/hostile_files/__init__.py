"""Hostile files, one row each: what is in it, and what every verb that reads its sort makes of it.

``test_hostile_files`` gives every row to every verb and holds ``docs/hostile-files.md`` against ``page()``.
``python -m tests.integration.hostile_files`` runs the table and writes the page anew.
"""
