"""Pseudonyms and the shift of times: both follow from a key, so that the same key links the sessions of a study.

A pseudonym is the beginning of the HMAC-SHA-256 of a name.  Without the key no names can be tested.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import NS_PER_S, GatewayError, matches

Times = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

#: Least length of a key, bytes.
MIN_KEY_BYTES = 16
#: A longer key counts as its SHA-256 (RFC 2104).
_BLOCK_BYTES = 64
#: Characters of a pseudonym behind its first letter: 35 bits.  ``AToB`` of two of them fits into a device name.
_LENGTH = 7
_WORD = re.compile(r"[A-Za-z0-9_]+")
_TO = re.compile(r"To(?=[A-Z])")
#: A longer name is replaced as a whole: no frame is named so, and each ``To`` in it would cost a look at all of it.
_LONGEST_A_TO_B = 255
_DAY_S = 86_400
_MAX_SHIFT_S = 3_650 * _DAY_S
#: Before 1990: no date, but a time since the start of a machine or of a simulation.
_FIRST_DATE_NS = 631_152_000 * NS_PER_S
#: Words of the protocols, of ROS and of the gateway: they identify no person.
WORDS = frozenset(
    "igtl in out tf tf_static clock rosout diagnostics parameter_events joint_states robot_description links map odom "
    "base_link world camera image image_raw image_color camera_info compressed unnamed".split()
)


@dataclass(slots=True)
class Pseudonyms:
    """The new names of one session.

    Attributes:
        key: the secret.
        given: name → new name, from the profile.
        kept: globs of names that stay.
        words: further names that stay, of the conversion table.
        changed: called with each name that is replaced.
        full: name cut to 20 bytes → full name, as far as the session has shown it.
        asked: the names, and their parts, that the profile may have.
    """

    key: bytes
    given: Mapping[str, str] = field(default_factory=dict)
    kept: tuple[str, ...] = ()
    words: frozenset[str] = WORDS
    changed: Callable[[], None] = lambda: None
    full: dict[str, str] = field(default_factory=dict)
    asked: set[str] = field(default_factory=set)
    _owners: dict[str, str] = field(default_factory=dict)
    _made: dict[str, str] = field(default_factory=dict)  # full name → its new name

    def __post_init__(self) -> None:
        if len(self.key) > _BLOCK_BYTES:
            self.key = hashlib.sha256(self.key).digest()  # as HMAC does it, but once and not for each name

    def name(self, name: str) -> str:
        """Return the new name; ``AToB`` is replaced part by part.  Raises GatewayError for equal new names."""
        new = self.label(name)
        if new != name:
            self.changed()
        return new

    def label(self, name: str) -> str:
        """As ``name``, for a report about the session: it counts as no replaced name."""
        full = self.full.get(name, name)
        new = self._made.get(full)
        if new is None:
            new = self._made[full] = self._name(full)
        return new

    def topic(self, topic: str) -> str:
        """Return the new name of a topic: segment by segment."""
        return "/".join(self.name(part) for part in topic.split("/"))

    def address(self, address: str, prefix: str = "peer") -> str:
        """Return the pseudonym of an address."""
        if not address:
            return ""
        self.changed()
        return f"{prefix}-{self._hash('address', address)}"

    def identifier(self, text: str) -> str:
        """Return the pseudonym of an identifier of a patient; "" stays."""
        return f"P{self._hash('patient', text)}" if text else ""

    def shift_ns(self) -> int:
        """Return the shift of all times: one day to ten years back, whole seconds, UTC ns."""
        number = int.from_bytes(hmac.digest(self.key, b"shift", hashlib.sha256)[:8], "big")
        return -(_DAY_S + number % (_MAX_SHIFT_S - _DAY_S)) * NS_PER_S

    def _name(self, name: str) -> str:
        parts = []
        while (new := self._known(name)) is None and (at := _end_of_first(name)):
            first = name[:at]
            parts.append(self._own(self._pseudonym(first), first) if (part := self._known(first)) is None else part)
            name = name[at + len("To") :]
        parts.append(self._own(self._pseudonym(name), name) if new is None else new)
        return "To".join([parts[0], *(part[:1].upper() + part[1:] for part in parts[1:])])

    def _known(self, name: str) -> str | None:
        """Return the new name of a name that stays or that the profile has; None for any other."""
        if not name or name in self.words:
            return name
        self.asked.add(name)
        if name in self.given:
            return self._own(self.given[name], name)
        return self._own(name, name) if any(matches(glob, name) for glob in self.kept) else None

    def _pseudonym(self, name: str) -> str:
        return f"N{self._hash('name', name)}"

    def _own(self, new: str, name: str) -> str:
        owner = self._owners.setdefault(new, name)
        if owner != name and name not in self.given:
            raise GatewayError(f"found the new name {new} for two names, expected another secret or map for one")
        return new

    def _hash(self, purpose: str, text: str) -> str:
        data = f"{purpose}\0".encode() + _encoded(text)
        digest = hmac.digest(self.key, data, hashlib.sha256)
        return base64.b32encode(digest).decode().lower()[:_LENGTH]


def _end_of_first(name: str) -> int:
    """Return the length of ``A`` if the name is ``AToB``; 0 for any other name."""
    if len(name) > _LONGEST_A_TO_B or not _WORD.fullmatch(name):
        return 0
    found = _TO.search(name, 1)
    return found.start() if found else 0


def _encoded(text: str) -> bytes:
    """Return any text as bytes, also halves of characters that JSON can have (``\\ud800``)."""
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        return text.encode("utf-8", "surrogatepass")


@dataclass(frozen=True, slots=True)
class TimeShift:
    """The constant that is added to all times that are dates.

    Attributes:
        by_ns: whole seconds, in ns.
        moved: called for each moved stamp.
    """

    by_ns: int
    moved: Callable[[], None] = lambda: None

    def ns(self, stamp_ns: int) -> int:
        """Return a moved time, UTC ns; 0 (unset) and times before 1990 (no dates) stay.

        Raises GatewayError for a time that no stamp of OpenIGTLink can have.
        """
        if stamp_ns < _FIRST_DATE_NS or not self.by_ns:
            return stamp_ns
        new = stamp_ns + self.by_ns
        if not 0 < new < (1 << 32) * NS_PER_S:
            raise GatewayError(
                f"--shift: found the time {new / NS_PER_S:.0f} s after it, expected one from 1970 to 2106"
            )
        self.moved()
        return new

    def rows(self, times: Times) -> tuple[Times, Mask, Mask]:
        """Return moved times as `ns` does, but uncounted; which of them are moved, and for which it would not raise."""
        if not self.by_ns:
            return times, np.zeros(len(times), np.bool_), np.ones(len(times), np.bool_)
        moved = times >= _FIRST_DATE_NS
        new = np.where(moved, times + self.by_ns, times)
        return new, moved, ~moved | ((new > 0) & (new < (1 << 32) * NS_PER_S))

    def ticks(self, ticks: int) -> int:
        """Return a moved time in ticks of 2^-32 s: the fraction stays to the bit."""
        whole = ticks >> 32
        return (self.ns(whole * NS_PER_S) // NS_PER_S) << 32 | (ticks & 0xFFFFFFFF)
