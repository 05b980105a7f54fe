"""The session file: an MCAP file and its layout; written, read, searched and salvaged.  Only this folder knows both.

The way through the folder, from bytes to sessions:

===================  ==================================================================================================
``records``          MCAP's records as bytes: opcodes, layouts, checksum, parsing and packing
``compression``      chunks in lz4 and zstd, both directions
``contents``         what is in a file and where: chunks, channels, counts
``chunk_columns``    the messages of a chunk as arrays, in C
``chunks``           one chunk: read, unpacked, taken apart into messages
``scan``, ``index``  the contents of a file: from its summary, or by one pass over its data
``index_check``      the indexes of messages, which have no checksum
``order``            the messages of a file in order of time
``layout``           topics, types, keys and metadata of a session; ``docs/reference/session-log.md`` specifies it
``messages``         an entry as a CDR message, and back
``channels``         what the record of a channel states of its entries
``schemas``          definitions of ROS message types for the file
``facts``            checks of session metadata and ledger
``stream``           MCAP being written; ``new_file`` creates the file
``beside``           every file that a verb writes: beside its place, moved there when it is complete
``writer``           entries → file; ``side_file``: the folder of a split recording
``reader``           file → entries
``columns``          entries in bulk: arrays, objects only for what is looked into; ``stream_rows``: written from them;
                     ``only``: entries of some kinds
``lookup``           starting in the middle of a file; ``places``: where a message lies in it
``damaged``          the records of a damaged file; ``salvage`` and ``salvage_report``: their messages, and the losses
``recovery``         the readable rest of a damaged file as a new one, which is read again
``sealing``          seals of a file that is written; ``seal_copy``: of one that exists
``units``, ``seals``  what seals cover, and the seals of a file; ``seal_check``, ``deviation``: each byte against them
``copying``          messages of one file into another as they are
``merged``           sessions of several recorders: their parts; `addons.merge.writer` writes them
``migrations``       files of older versions
===================  ==================================================================================================

Programs use ``reader.SessionFile``, ``writer.SessionWriter``, ``salvage.Salvage`` and ``copying.CopyWriter``.

Files from elsewhere are untrusted input, so everything is read within the limits of ``untrusted.limits``.  The ``mcap``
library packs small records; it does not read files, because it allocates what a file claims.  The specification of MCAP
is https://mcap.dev/spec.
"""
