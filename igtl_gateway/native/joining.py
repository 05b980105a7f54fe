"""``join_parts``: a list of buffers as one ``bytes`` object, copied without the interpreter lock; None if not compiled.

Many bytes are copied into large pages, where the system has them: to get and to give back the small pages of a hundred
megabytes takes longer than the copy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

join_parts: Callable[[Sequence[bytes | bytearray | memoryview]], bytes] | None = None

if not TYPE_CHECKING:
    try:
        from igtl_gateway.native._express import join_parts  # noqa: F401
    except ImportError:  # pragma: no cover - installed without the C part
        pass
