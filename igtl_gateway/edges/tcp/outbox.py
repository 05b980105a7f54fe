"""The send queue of one peer, and its rule for what to drop when it is full."""

from __future__ import annotations

from collections import Counter, OrderedDict, deque
from collections.abc import Sequence
from itertools import islice

from igtl_gateway.edges.tcp.link_info import PeerLimits

IOV_MAX = 1024  # buffers that one sendmsg takes (IOV_MAX of Linux and macOS)

#: A droppable message of this size or more waits in the lane of large messages.
LARGE_BYTES = 64 << 10

#: Bytes of smaller messages that may overtake a large message: it waits longer by their time, and no more.
_OVERTAKING_BYTES = 8 << 20

Part = bytes | memoryview


class QueuedMessage:
    """One message in the queue: the buffers still to be sent."""

    __slots__ = ("keep", "left", "parts", "stream")

    def __init__(self, parts: Sequence[Part], left: int, stream: str, keep: bool) -> None:
        self.parts = parts
        self.left = left
        self.stream = stream
        self.keep = keep

    def advance(self, count: int) -> None:
        """``count`` more bytes are sent (less than what is left)."""
        self.left -= count
        for index, part in enumerate(self.parts):
            if count < len(part):
                self.parts = [part[count:], *self.parts[index + 1 :]]
                return
            count -= len(part)


class Outbox:
    """Messages waiting for one link, within bounds.  Not locked: the sender's lock guards it.

    A message that has begun to be sent is always completed; the bounds are for the messages behind it, among which one
    message of any size may wait.

    There are two lanes, so that a pose does not wait for the pictures before it: messages with ``keep=False`` wait in
    the second from ``LARGE_BYTES`` on, and the first is sent before it.  The messages of a stream keep their order, and
    so do all messages with ``keep=True``.

    When there is no room for a new message:

    1. the oldest waiting message of the same stream with ``keep=False`` is dropped: the newer one replaces it;
    2. else the oldest with ``keep=False`` of the stream that holds the most of what is exhausted (bytes or messages);
    3. if dropping all of them would not suffice, only the new message is dropped, or, if it has ``keep=True`` as well,
       it is refused, and the link must be closed.
    """

    def __init__(self, limits: PeerLimits) -> None:
        self.sent_messages = 0
        self.sent_bytes = 0
        self.dropped: Counter[str] = Counter()
        self.drops = 0  # pushed out
        self.unsent = 0  # left over at the end
        self.waiting_bytes = 0
        self._limits = limits
        self._begun: QueuedMessage | None = None
        self._waiting: OrderedDict[int, QueuedMessage] = OrderedDict()
        self._large: OrderedDict[int, QueuedMessage] = OrderedDict()  # the second lane
        self._large_streams: Counter[str] = Counter()  # messages of each stream in it
        self._overtaking = 0  # bytes that came before it since a message of it was sent
        self._serial = 0
        # per stream the waiting messages that may be dropped, oldest first, and their bytes
        self._droppable: dict[str, deque[int]] = {}
        self._droppable_bytes: Counter[str] = Counter()
        self._kept_messages = 0
        self._kept_bytes = 0

    @property
    def empty(self) -> bool:
        return self._begun is None and not self._waiting and not self._large

    @property
    def messages(self) -> int:
        return self._waiting_messages + (self._begun is not None)

    @property
    def bytes(self) -> int:
        return self.waiting_bytes + (self._begun.left if self._begun else 0)

    def has_room(self, size: int) -> bool:
        """Whether a message of ``size`` bytes can be added without dropping any."""
        return self._fits(self._waiting_messages, self.waiting_bytes, size)

    def add(self, message: QueuedMessage) -> bool:
        """Add it, making room if need be; False if it is refused (case 3 above)."""
        if not self.has_room(message.left):
            if not self._fits(self._kept_messages, self._kept_bytes, message.left):
                if not message.keep:
                    self._count_drop(message)
                return not message.keep
            while not self.has_room(message.left):
                self._drop_one(message.stream)
        self._serial += 1
        self._lane(message)[self._serial] = message
        self.waiting_bytes += message.left
        if message.keep:
            self._kept_messages += 1
            self._kept_bytes += message.left
        else:
            self._droppable.setdefault(message.stream, deque()).append(self._serial)
            self._droppable_bytes[message.stream] += message.left
        return True

    def begin(self, message: QueuedMessage, sent: int) -> None:
        """To an empty box: a message of which the first ``sent`` bytes are sent."""
        message.advance(sent)
        self.sent_bytes += sent
        self._begun = message

    def count_sent(self, size: int, messages: int = 1) -> None:
        """A message of ``size`` bytes, or several of that total size, were sent without being queued."""
        self.sent_messages += messages
        self.sent_bytes += size

    def parts(self) -> list[Part]:
        """The next buffers to be sent, as many as one system call takes."""
        parts = list(self._begun.parts[:IOV_MAX]) if self._begun else []
        # no large message behind others: while these are sent, a smaller one may come
        waiting = self._waiting or ({} if self._begun else dict(islice(self._large.items(), 1)))
        for message in islice(waiting.values(), IOV_MAX - len(parts)):
            parts += message.parts
            if len(parts) >= IOV_MAX:
                return parts[:IOV_MAX]
        return parts

    def advance(self, count: int) -> None:
        """The first ``count`` bytes of ``parts()`` are sent."""
        self.sent_bytes += count
        while count:
            message = self._begun or self._pop_first()
            if count < message.left:
                message.advance(count)
                self._begun = message
                return
            count -= message.left
            self._begun = None
            self.sent_messages += 1

    def clear(self) -> None:
        """Count everything that is left as dropped."""
        left = [self._begun] if self._begun else []
        self._begun = None
        while not self.empty:
            left.append(self._pop_first())
        self.unsent += len(left)
        self.dropped.update(message.stream for message in left)

    def _fits(self, messages: int, size: int, new: int) -> bool:
        limits = self._limits
        return not messages or (messages < limits.queue_messages and size + new <= limits.queue_bytes)

    @property
    def _waiting_messages(self) -> int:
        return len(self._waiting) + len(self._large)

    def _lane(self, message: QueuedMessage) -> OrderedDict[int, QueuedMessage]:
        """Where a new message waits."""
        if not message.keep and (message.left >= LARGE_BYTES or message.stream in self._large_streams):
            self._large_streams[message.stream] += 1
            return self._large
        if self._large:
            self._overtaking += message.left
            if self._overtaking > _OVERTAKING_BYTES:
                self._waiting |= self._large
                self._large.clear()
                self._large_streams.clear()
                self._overtaking = 0
        return self._waiting

    def _leaves_large(self, message: QueuedMessage) -> None:
        """A message has left the lane of large messages."""
        self._large_streams[message.stream] -= 1
        if not self._large_streams[message.stream]:
            del self._large_streams[message.stream]

    def _pop_first(self) -> QueuedMessage:
        if self._waiting:
            _, message = self._waiting.popitem(last=False)
        else:
            _, message = self._large.popitem(last=False)
            self._leaves_large(message)
            self._overtaking = 0
        if message.keep:
            self._kept_messages -= 1
            self._kept_bytes -= message.left
        else:
            self._forget(message)  # the first of all is the first of its stream
        self.waiting_bytes -= message.left
        return message

    def _drop_one(self, stream: str) -> None:
        if stream not in self._droppable:
            if self._waiting_messages >= self._limits.queue_messages:
                stream = max(self._droppable, key=lambda name: len(self._droppable[name]))
            else:
                stream = max(self._droppable, key=self._droppable_bytes.__getitem__)
        serial = self._droppable[stream][0]
        if (message := self._large.pop(serial, None)) is not None:
            self._leaves_large(message)
        else:
            message = self._waiting.pop(serial)
        self._forget(message)
        self.waiting_bytes -= message.left
        self._count_drop(message)

    def _forget(self, message: QueuedMessage) -> None:
        """Take the oldest of its stream off the books of what may be dropped."""
        self._droppable_bytes[message.stream] -= message.left
        self._droppable[message.stream].popleft()
        if not self._droppable[message.stream]:
            del self._droppable[message.stream], self._droppable_bytes[message.stream]

    def _count_drop(self, message: QueuedMessage) -> None:
        self.dropped[message.stream] += 1
        self.drops += 1
