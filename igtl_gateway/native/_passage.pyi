from typing_extensions import Buffer, Self

class Lock:
    """A lock that Python and the native passage share."""

    def __enter__(self) -> Self: ...
    def __exit__(self, *error: object) -> None: ...

class Stream:
    """A compiled stream of the native passage; all methods need the sequence lock."""

    received: int
    is_stale: bool
    @property
    def is_in_use(self) -> bool:
        """Whether a message is being given to the links: then what they ignore may still be counted."""
    def remove(self) -> None: ...
    def collect(
        self,
    ) -> tuple[int, int, int, tuple[int, ...], tuple[int, ...], tuple[int, int, int, bytes, int] | None]: ...
    def guard_with(self, guard: Guard, /) -> None: ...

class Guard:
    """The state of a guarded stream; all methods need the sequence lock."""

    is_dirty: bool
    def passes(self, now_ns: int, stamp_ns: int, *place: float) -> bool:
        """Judge a message as the passage does; for the tests."""
    def collect(
        self,
    ) -> tuple[tuple[int, int, int, int, int, int, tuple[float, float, float] | None], list[tuple[int, int]]]: ...
    def set(
        self,
        watches: bool,
        judged_by_python: bool,
        knows_age: bool,
        max_age_ns: int,
        ahead_ns: int,
        last_ns: int,
        look_ns: int,
        due_ns: int,
        episode_ends_ns: int,
        seen_ns: int,
        arrived_ns: int,
        still: int,
        place: tuple[float, float, float] | None,
        /,
    ) -> None: ...

class Publisher:
    def __init__(self, pointer: int, latched: bool = False, /) -> None: ...
    def collect(self) -> tuple[int, int, int]: ...
    def take_own(self) -> list[tuple[int, int, bytes]]: ...
    def take_sizes(self) -> list[int]: ...
    def leave(self) -> None: ...

class Link:
    number: int
    stream_count: int
    received_messages: int
    received_bytes: int
    heard_ns: int
    room: float
    pauses: int
    waits: bool
    muted: bool
    unsent_bytes: int
    pending: int
    sent_messages: int
    sent_bytes: int
    is_native: bool
    clear: bool
    is_framed: bool
    def __init__(
        self, passage: Passage, number: int, descriptor: int, sending: Lock, is_framed: bool = False, /
    ) -> None: ...
    def read_natively(self, room: float, rate: float, /) -> None: ...
    def read_by_python(self) -> tuple[bytes, int]: ...
    def take_unsent(self) -> tuple[bytes, int, str, bool] | None: ...
    def close(self) -> None: ...
    large_waiting: int
    large_bytes: int
    def add_large(self, names: bytes, most: int, /) -> None: ...
    def take_pauses(self) -> int: ...
    def take_large(self) -> bytes | memoryview | bool | None: ...
    def large_done(self) -> None: ...

class Subscription:
    last_number: int
    def __init__(self, passage: Passage, pointer: int, /) -> None: ...
    def take(self) -> tuple[bytes, int, int] | int | None: ...
    def again(self) -> None: ...
    def collect(self) -> tuple[int, int, int]: ...

class Passage:
    seq: int
    stamp_ns: int
    last_ns: int
    ahead_ns: int
    builds_all: bool
    closed: bool
    large_bytes: int
    def __init__(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *error: object) -> None: ...
    def to_ros(
        self,
        link: Link,
        names: bytes,
        sample: bytes,
        at: int,
        size: int,
        check_crc: bool,
        own: bool,
        times: float,
        by: float,
        place_at: int,
        number: int,
        outputs: tuple[tuple[bytes, int, int, Publisher], ...],
        /,
    ) -> Stream: ...
    def to_igtl(
        self,
        subscription: Subscription,
        sample: bytes,
        first_end: int,
        second: int,
        end: int,
        size: int,
        own: bool,
        times: float,
        by: float,
        number: int,
        outputs: tuple[tuple[bytes, int, int, int, str, tuple[Link, ...]], ...],
        /,
    ) -> Stream: ...
    def to_ros_bulk(
        self,
        link: Link,
        names: bytes,
        sample: bytes,
        at: int,
        tail: int,
        check_crc: bool,
        own: bool,
        times: float,
        by: float,
        number: int,
        outputs: tuple[tuple[int, bytes, int, int, int, int, Publisher], ...],
        keeps: bool,
        /,
    ) -> Stream: ...
    def to_igtl_bulk(
        self,
        subscription: Subscription,
        sample: bytes,
        places: tuple[int, ...],
        form: int,
        own: bool,
        times: float,
        by: float,
        number: int,
        outputs: tuple[tuple[bytes, bytes, int, int, str, bool, tuple[Link, ...]], ...],
        /,
    ) -> Stream: ...
    def recheck(
        self,
        columns: tuple[Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, Buffer, Buffer],
        streams: tuple[Link | Subscription | None, ...],
        row: int,
        last_number: int,
        /,
    ) -> tuple[int, int, int, int]: ...
    def use_rcl(self, take: int, publish: int, subscribers: int, /) -> None: ...
    def record_into(self, memory: Buffer, lock: Lock, /) -> None: ...
    def set_callback(self, function: int, subscription: Subscription, on: bool, /) -> int: ...
    def times(self) -> list[list[tuple[int, int]]]: ...
    def wait_links(self) -> list[Link]: ...
    def wait_large(self, waits: bool, /) -> list[Link]: ...
    def wait_subscriptions(self) -> list[Subscription]: ...
    def wait_recorder(self) -> int: ...
    def wake(self) -> None: ...
    def fill(self) -> None: ...
