"""The parts in C of the core, and the headers that they share.

* ``_express``: conversions of compiled streams (`igtl_gateway.convert.express`), and `igtl_gateway.native.joining`.
* ``_queue``: entries into the recorder's memory (`igtl_gateway.record.shared_queue`).
* ``_chunk``: the recorder's rows to a chunk of MCAP (`igtl_gateway.record.sessionfile.chunk_rows`).
* ``_passage``: the native passage (`igtl_gateway.native.passage`).

A module of Python does the same as each of the first three; without a compiler, the passage is missing.
"""
