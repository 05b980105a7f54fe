"""The parts in C of the core: rooms by purpose, and a door for each user in Python.

Rooms, each a folder of headers:

* ``kernel/``: bytes, CRC, poses, points, surfaces, pictures, tools, the recorder's queue, records of MCAP.  Neither
  Python nor threads nor a clock; each header compiles alone.
* ``passage/``: the native passage (`igtl_gateway.native.passage`), with its binding to Python in ``passage/python/``.
  ``passage/STATES.md`` has the states of a large message and of a subscription.

Doors: ``_NAME.c`` is a module of Python, compiled as one unit with the headers that it includes, so that short
functions are inlined.

* ``_express``: conversions of compiled streams (`igtl_gateway.convert.express`), and `igtl_gateway.native.joining`.
* ``_queue``: entries into the recorder's memory (`igtl_gateway.record.shared_queue`).
* ``_chunk``: the recorder's rows to a chunk of MCAP (`igtl_gateway.record.sessionfile.chunk_rows`).
* ``_columns``: the messages of an unpacked chunk as columns (`igtl_gateway.record.sessionfile.chunk_columns`).
* ``_passage``: the native passage.

Without a compiler, Python does their work: by a function with an equal result (poses, ``put_entry``,
``index_messages``, ``_columns``), or on its full path, with the same bytes (bulk, ``add_rows``, the passage).
"""
