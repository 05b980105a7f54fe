"""The fast path: a cache of compiled conversions, for the next message of a stream when only its numbers are new.

The full path of a message (``to_ros``, ``to_igtl``) asks many questions whose answers are the same for every message of
a stream: which rows, names, frames, peers.  For poses, which come a thousand times a second, and for texts, points,
clouds and pictures, the answers are compiled from a message that took the full path.  The next message then gives
exactly the entries, and the ledger exactly the counts, that the full path would have given; or it takes the full path.

It is entered at one place, ``FastPath.take``, before a message gets its entry, and left at one place: by what ``take``
returns.  ``FastPath.learn`` compiles.  What was compiled holds until something changes that it came from: a peer that
comes, goes, shows what it is or asks for streams ends all of it.
"""

from igtl_gateway.gateway.fastpath.cache import Fast, FastPath, no_fast_path

__all__ = ["Fast", "FastPath", "no_fast_path"]
