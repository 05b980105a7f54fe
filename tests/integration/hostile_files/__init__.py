"""Hostile files, one row each: what is in it, and the result of every verb that reads its sort.

``test_hostile_files`` gives every row to every verb and compares ``docs/evidence/hostile-files.md`` with ``page()``.
``python -m tests.integration.hostile_files`` runs the table and writes the page again.
"""
