"""BLAKE3, the digest of what a seal covers.

A recorder digests all that it writes.  Without SHA instructions, SHA-256 takes ten times as long.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.base.errors import Unavailable
from igtl_gateway.base.extras import missing

if TYPE_CHECKING:
    from blake3 import blake3

#: Name of the digest in a statement.
NAME = "blake3"


def new_digest() -> blake3:
    """Return a BLAKE3 of no bytes yet; its digest has 32 bytes.  Raises Unavailable where it is not installed."""
    try:
        from blake3 import blake3
    except ImportError as error:
        raise Unavailable(missing("blake3", error)) from None
    return blake3()
