"""The session file, an MCAP file: its layout, written, read, searched and salvaged.

Files that somebody else may have written are read within the limits: records, index, chunks, messages in order.  The
``mcap`` library writes our files; it is not asked to read foreign ones, because it allocates what a file claims.  The
specification is https://mcap.dev/spec; a record may have more bytes at its end than its fields need.
"""
