"""How addresses, networks, sizes, CPUs and pairs are written in settings: on the command line, in files, as parameters.

Each function returns the value of a string, or raises ConfigError with what it found and what it expected.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.untrusted.numbers import whole_number

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 18944
#: How globs of streams are written.
STREAM = "by TYPE/device, device or topic; * matches one level, ** any number"

#: The usual way to the ROS graph: by an installed ROS.
DDS = "dds"

#: Units of an age in seconds, and of a size in bytes.
_AGES = {"h": 3600, "d": 86_400, "w": 7 * 86_400}
_SIZES = {"MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 1 << 20, "GiB": 1 << 30, "TiB": 1 << 40}
#: Longest age, a hundred years, and largest size, an exabyte.
_MOST_AGE_S, _MOST_BYTES = 36_525 * 86_400, 10**18
_QUANTITY = re.compile(r"([0-9]{1,15}(?:\.[0-9]{1,9})?) ?([A-Za-z]+)")

#: Host and port of an origin.
_HOST = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]{1,5})?")

_LAST_CPU = 8191  # of any Linux


#: Suffixes of file names that users know as one format.
_FORMATS = {
    ".mcap": "a recording (MCAP)",
    ".rrd": "a recording of rerun",
    **dict.fromkeys((".mrb", ".mrml"), "a scene of 3D Slicer"),
    ".bag": "a bag of ROS 1",
    ".db3": "a bag of ROS 2 (SQLite)",
    ".igtl": "OpenIGTLink bytes",
    ".xml": "a report (XML)",
    **dict.fromkeys((".pcap", ".pcapng"), "a network capture"),
    **dict.fromkeys((".mha", ".mhd", ".nrrd", ".nhdr", ".nii"), "an image or a volume"),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".svg", ".gif"), "a picture"),
    **dict.fromkeys((".mp4", ".avi", ".mkv"), "a video"),
    **dict.fromkeys((".csv", ".parquet", ".arrow"), "a table"),
    **dict.fromkeys((".toml", ".yaml", ".yml", ".json"), "a configuration"),
    **dict.fromkeys((".pem", ".key"), "a key"),
    **dict.fromkeys((".html", ".pdf", ".txt", ".md"), "a document"),
    **dict.fromkeys((".gz", ".zip", ".zst", ".zstd"), "a compressed file"),
}


#: Scheme of an address → whether it uses TLS (None: where TLS is the usual), and WebSocket.
_SCHEMES = {"": (None, False), "tls": (True, False), "tcp": (False, False), "wss": (True, True), "ws": (False, True)}


class PeerAddress(tuple[str, int]):
    """Host and port; ``scheme`` is one of the table, or ``""``."""

    scheme = ""


@dataclass(frozen=True, slots=True)
class RetentionRule:
    """Which recordings are deleted.

    Attributes:
        text: as it was written.
        age_s: those that were closed longer ago, seconds; 0: of any age are kept.
        size: the oldest, while all together are larger than this, bytes; 0: any size is kept.
    """

    text: str
    age_s: int = 0
    size: int = 0


def address(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT``, ``:PORT``, ``PORT`` or ``HOST``; IPv6 hosts in brackets."""
    host, colon, port = text.rpartition(":")
    if text.startswith("[") and text.endswith("]"):
        host, colon, port = text, "", ""
    elif not colon:
        host, port = ("", text) if whole_number(text) is not None else (text, "")
    number = whole_number(port, (1 << 16) - 1) if port else DEFAULT_PORT
    if number is None:
        raise ConfigError(f"found {text!r}, expected HOST:PORT with a port from 0 to 65535")
    return host.strip("[]") or DEFAULT_HOST, number


def peer_address(text: str) -> PeerAddress:
    """Parse ``[tls://|tcp://]HOST:PORT``; the part behind the scheme as in ``address``."""
    return _with_scheme(text, "tls", "tcp")


def listen_address(text: str) -> PeerAddress:
    """Parse ``[tls://|tcp://|ws://|wss://]HOST:PORT``; the part behind the scheme as in ``address``."""
    return _with_scheme(text, "tls", "tcp", "ws", "wss")


def _with_scheme(text: str, *schemes: str) -> PeerAddress:
    scheme, found, rest = text.partition("://")
    if found and scheme not in schemes:
        if scheme in _SCHEMES:
            raise ConfigError(f"found {text!r}, expected no {scheme}://: only --listen of bridge and replay takes it")
        places = ", ".join(f"{each}://HOST:PORT" for each in schemes)
        raise ConfigError(f"found {text!r}, expected {places} or HOST:PORT")
    made = PeerAddress(address(rest if found else text))
    made.scheme = scheme if found else ""
    return made


def uses_tls(place: tuple[str, int], usual: bool) -> bool:
    """Return whether an address uses TLS: by its scheme, or else as usual."""
    tls, _ = _SCHEMES[getattr(place, "scheme", "")]
    return usual if tls is None else tls


def uses_websocket(place: str | tuple[str, int]) -> bool:
    """Return whether peers speak WebSocket at an address."""
    return _SCHEMES[getattr(listen_address(place) if isinstance(place, str) else place, "scheme", "")][1]


def origin(text: str) -> str:
    """Return an origin of web pages: ``http[s]://HOST[:PORT]``, ``null`` or ``*``."""
    scheme, found, host = text.partition("://")
    parts = _HOST.fullmatch(host) if found and scheme in ("http", "https") else None
    is_right = parts and (not parts[2] or whole_number(parts[2][1:], (1 << 16) - 1) is not None)
    if text not in ("*", "null") and not is_right:
        raise ConfigError(f"found {text!r}, expected an origin such as https://viewer.clinic:8443, null or *")
    return text


def recording_name(text: str) -> str:
    """Return the name of a recording to write, see ``named``."""
    return named(text, ".mcap")


def named(text: str, *suffixes: str) -> str:
    """Return the name of a file to write, unless its suffix is that of another format: a reader would be misled.

    Any other suffix is part of a name (``day.2``).  ``suffixes`` are those of the format that is written; a directory
    has none.
    """
    _, dot, end = text.rpartition("/")[2].rpartition(".")
    found = f".{end.lower()}" if dot else ""
    if found in suffixes or found not in _FORMATS:
        return text
    expected = f"{_FORMATS[suffixes[0]]}: *{' or '.join(suffixes)}" if suffixes else "a directory"
    raise ConfigError(f"found {text!r}, the name of {_FORMATS[found]}, expected {expected}")


def network(text: str) -> str:
    """Return a network such as ``192.168.7.0/24``, an address, or ``any``."""
    try:
        if text != "any":
            ipaddress.ip_network(text, strict=False)
    except ValueError:
        raise ConfigError(f"found {text!r}, expected a network such as 192.168.7.0/24, or any") from None
    return text


def size_by_type(text: str) -> tuple[str, int]:
    """Parse ``TYPE=MIB``; return type and bytes."""
    name, equals, number = text.partition("=")
    try:
        if name and equals and (mib := float(number)) > 0:
            return name, round(mib * 2**20)
    except (ValueError, OverflowError):
        pass
    raise ConfigError(f"found {text!r}, expected TYPE=MIB such as STRING=4")


def type_glob(text: str) -> str:
    """Return a message type or a glob of types: printable ASCII without blanks."""
    if not (text.isascii() and text.isprintable() and bool(text) and not set(text) & set(" /,")):
        raise ConfigError(f"found {text!r}, expected a type or a glob such as COMMAND, GET_*")
    return text


def device_glob(text: str) -> str:
    """Return a device of CRTK or a glob of them: printable ASCII without blanks and without a slash before it."""
    if not (text.isascii() and text.isprintable() and text.strip("/") == text != "" and not set(text) & set(" ,")):
        raise ConfigError(f"found {text!r}, expected a device or a glob such as PSM1/servo_cp, PSM*/move_*")
    return text


def any_device(text: str) -> str:
    """Return the name of a device or a glob of names: printable, without blanks, for which ``?`` stands."""
    if not text.isprintable() or not text or " " in text:
        raise ConfigError(f"found {text!r}, expected a device or a glob without blanks such as Marks, Nurse*")
    return text


def address_glob(text: str) -> str:
    """Return an address ``HOST:PORT`` or a glob of addresses."""
    if not text.isprintable() or ":" not in text or " " in text:
        raise ConfigError(f"found {text!r}, expected HOST:PORT or a glob such as 192.168.7.4:*")
    return text


def key_value(text: str) -> tuple[str, str]:
    """Parse ``KEY=VALUE``."""
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise ConfigError(f"found {text!r}, expected KEY=VALUE")
    return key, value


def file_mode(text: str) -> int:
    """Parse the mode of new files, such as ``0640``: octal, with read and write for their owner, without execute."""
    try:
        mode = int(text, 8) if text.isascii() and text.isdigit() and len(text) <= 4 else 0
    except ValueError:
        mode = 0
    if mode & 0o600 != 0o600 or mode & ~0o666:
        raise ConfigError(f"found {text!r}, expected an octal mode such as 0600 or 0640")
    return mode


def cpus(text: str) -> frozenset[int]:
    """Parse a list of CPUs such as ``2,4-6``."""
    found: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        begin, end = whole_number(first), whole_number(last if dash else first)
        if begin is None or end is None:
            raise ConfigError(f"found {text!r}, expected CPUs such as 2,4-6")
        if end < begin or end > _LAST_CPU:
            raise ConfigError(f"found {part.strip()!r}, expected CPUs in ascending order, up to {_LAST_CPU}")
        found.update(range(begin, end + 1))
    return frozenset(found)


def retention(text: str) -> RetentionRule:
    """Parse a retention such as ``30 d, 200 GB``: an age, a size, or both."""
    age_s = size = 0
    for part in text.split(","):
        found = _QUANTITY.fullmatch(part.strip())
        number, unit = found.groups() if found else ("", "")
        if unit in _AGES and not age_s:
            age_s = _quantity(part, number, _AGES[unit], _MOST_AGE_S, "at most 36525 d")
        elif unit in _SIZES and not size:
            size = _quantity(part, number, _SIZES[unit], _MOST_BYTES, "at most 1000000 TB")
        else:
            second = " once" if unit in _AGES or unit in _SIZES else ""
            raise ConfigError(
                f"found {part.strip()!r} in {text!r}, expected an age ({', '.join(_AGES)}) or a size "
                f"({', '.join(_SIZES)}){second}, such as 30 d, 200 GB"
            )
    return RetentionRule(text, age_s, size)


def _quantity(part: str, number: str, unit: int, most: int, most_text: str) -> int:
    value = round(float(number) * unit)
    if value < 1:
        raise ConfigError(f"found {part.strip()!r}, expected more than 0")
    if value > most:
        raise ConfigError(f"found {part.strip()!r}, expected {most_text}")
    return value
