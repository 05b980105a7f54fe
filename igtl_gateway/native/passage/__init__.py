"""The native passage: compiled streams of poses pass from one side to the other without the GIL.

A robot's pose needs 2 µs of arithmetic.  On its way through Python it waits for the GIL, for threads that are woken,
and for code that is no longer in the caches: hundreds of microseconds at 30 Hz.  The passage (the headers of this
folder, compiled by ``_passage.c``) is the same way in C:

* to OpenIGTLink: in the thread of the middleware that received the message, from ``rcl_take_serialized_message`` to
  ``send``;
* to ROS: in one thread that reads all links, from ``recv`` to ``rcl_publish_serialized_message``.

Large pictures and clouds pass in two threads of Python's, which need the GIL only between messages.  The sequence lock
covers no more than their number.

It passes only what a compiled stream (`igtl_gateway.gateway.fastpath`) fits, with the same numbers, stamps, counts and
bytes as Python.  Everything else goes to Python: the message, and the link or the subscription with it, until Python
has nothing more to do for it.

Python and the passage share one lock, the *sequence lock* (the context of a ``Passage``): it guards the numbers of the
entries, the streams and their counts.  Python sees the counts when it collects them
(`igtl_gateway.gateway.fastpath.passage_streams`).

The passage is optional: without a C compiler or on another system than Linux, ``is_compiled`` is false, and without rcl
a bridge makes none (`igtl_gateway.app.passage`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from igtl_gateway.native._passage import Guard, Link, Lock, Passage, Publisher, Stream, Subscription
else:
    try:
        from igtl_gateway.native._passage import Guard, Link, Lock, Passage, Publisher, Stream, Subscription
    except ImportError:  # installed without the C part
        Guard = Link = Lock = Passage = Publisher = Stream = Subscription = None

__all__ = ["Guard", "Link", "Lock", "Passage", "Publisher", "Stream", "Subscription", "is_compiled"]


def is_compiled() -> bool:
    """Return whether the package was installed with the passage."""
    return Passage is not None
