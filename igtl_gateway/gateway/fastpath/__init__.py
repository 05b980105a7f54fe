"""The fast path: a cache of compiled conversions for messages of which only the numbers and the stamp are new.

The full path (``to_ros``, ``to_igtl``) looks up rows, names, frames and peers, with the same result for every message
of a stream.  For poses (up to thousands a second), tracking data, strings, points, clouds, surfaces and images, these
results are compiled from a message that took the full path.  The next message then gives exactly the entries and the
counts that the full path would give, or it takes the full path.

The only entry is ``FastPath.take``, before a message gets its entry; the only exit is its return value.
``FastPath.learn`` compiles.  Compiled streams are dropped when what they depend on changes: when a peer connects,
disconnects, shows its version or profile, or requests streams.
"""

from igtl_gateway.gateway.fastpath.cache import (
    LARGE_BYTES,
    FastHandler,
    FastPath,
    Prepared,
    PrepareMessage,
    no_fast_path,
)

__all__ = ["LARGE_BYTES", "FastHandler", "FastPath", "PrepareMessage", "Prepared", "no_fast_path"]
