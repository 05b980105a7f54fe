"""Guards for data of other programs and people: opening files, limits for reading them, and printing their text.

Every reader opens files with :mod:`.files` and checks :mod:`.limits` before it allocates, unpacks, nests or
repeats.  All printed text passes :func:`.text.printable`.
``docs/evidence/hostile-files.md`` lists the tested files.
"""
