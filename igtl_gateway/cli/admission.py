"""Options for peers: who may connect, TLS, denied messages, limits."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from igtl_gateway.cli.options import Options, address, default
from igtl_gateway.config import Config
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.errors import ConfigError
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.wire.registry import BODIES

_USUAL = PeerLimits()
_NEVER = TlsFiles()


class PeerAddress(tuple[str, int]):
    """Host and port; ``scheme`` is ``"tls"``, ``"tcp"`` or ``""``."""

    scheme = ""


def peer_address(text: str) -> PeerAddress:
    """Parse ``[tls://|tcp://]HOST:PORT``; the part behind the scheme as in ``options.address``."""
    scheme, found, rest = text.partition("://")
    if found and scheme not in ("tls", "tcp"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected tls://HOST:PORT, tcp://HOST:PORT or HOST:PORT")
    made = PeerAddress(address(rest if found else text))
    made.scheme = scheme if found else ""
    return made


def add_tls(parser: Options) -> None:
    """Options for TLS and its files."""
    parser.add_argument(
        "--tls", action="store_true", help="use TLS at all addresses except those that begin with tcp://"
    )
    parser.add_argument(
        "--tls-cert", type=Path, metavar="FILE", help="own certificate (PEM); turns TLS on for --listen"
    )
    parser.add_argument(
        "--tls-key",
        type=Path,
        metavar="FILE",
        help="private key of the certificate (PEM) " + default("file of --tls-cert"),
    )
    parser.add_argument(
        "--tls-ca", type=Path, metavar="FILE", help="require a certificate of this CA (PEM) from clients and servers"
    )


def add_limits(parser: Options) -> None:
    """Options for the resources that one peer may use; without a value they are None, see ``edge_file``."""
    parser.add_argument(
        "--max-clients",
        type=int,
        metavar="N",
        help="maximum number of connected clients " + default(_USUAL.max_clients),
    )
    parser.add_argument(
        "--queue-mib", type=int, metavar="MIB", help="size of the send queue " + default(_USUAL.queue_bytes >> 20)
    )
    parser.add_argument(
        "--queue-messages",
        type=int,
        metavar="N",
        help="number of messages in the send queue " + default(_USUAL.queue_messages),
    )
    parser.add_argument(
        "--max-body-mib", type=int, metavar="MIB", help="maximum body size " + default(_USUAL.max_body >> 20)
    )
    parser.add_argument(
        "--max-body",
        type=size_by_type,
        action="append",
        default=[],
        metavar="TYPE=MIB",
        help="maximum body size of a message type or of 'GET_*' (repeatable) "
        + default("2 for strings and poses, 16 for lists, 64 for VIDEO"),
    )
    parser.add_argument(
        "--max-messages",
        type=int,
        metavar="HZ",
        help="maximum rate of messages; a peer that sends faster is slowed down " + default(_USUAL.messages_per_s),
    )
    parser.add_argument(
        "--stall-s",
        type=float,
        metavar="SECONDS",
        help="longest pause inside a message " + default(f"{_USUAL.stall_s:g}"),
    )
    parser.add_argument(
        "--min-rate-kib",
        type=float,
        metavar="KIB/S",
        help="lowest transfer rate of a message " + default(f"{_USUAL.min_rate / 2**10:g}"),
    )
    parser.add_argument(
        "--idle-s",
        type=float,
        metavar="SECONDS",
        help="close a link after this time without traffic in either direction; 0: never "
        + default(f"{_USUAL.idle_s:g}"),
    )


def size_by_type(text: str) -> tuple[str, int]:
    """Parse ``TYPE=MIB``; return type and bytes."""
    name, equals, number = text.partition("=")
    try:
        if name and equals and (mib := float(number)) > 0:
            return name, round(mib * 2**20)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"found {text!r}, expected TYPE=MIB such as STRING=4")


def limits(options: argparse.Namespace) -> PeerLimits:
    """Return the limits of a peer.  Raises ConfigError."""
    return PeerLimits(
        max_clients=options.max_clients,
        queue_bytes=options.queue_mib << 20,
        queue_messages=options.queue_messages,
        stall_s=options.stall_s,
        min_rate=round(options.min_rate_kib * 2**10),
        idle_s=options.idle_s,
        max_body=options.max_body_mib << 20,
        bodies=tuple(options.max_body),
        messages_per_s=options.max_messages,
    )


def tls(options: argparse.Namespace) -> TlsFiles:
    """Return the files of TLS."""
    return TlsFiles(options.tls_cert, options.tls_key, options.tls_ca)


def secured(
    options: argparse.Namespace, listen: Sequence[tuple[str, int]], connect: Sequence[tuple[str, int]]
) -> tuple[frozenset[tuple[str, int]], frozenset[tuple[str, int]]]:
    """Return the addresses with TLS: (listening, servers).  Raises ConfigError for files without such an address.

    A certificate turns TLS on for all listening addresses except those with ``tcp://``: a user who gives one must not
    discover later that the traffic was not encrypted.
    """
    ours = _with_tls(listen, options.tls or bool(options.tls_cert))
    servers = _with_tls(connect, options.tls)
    if tls(options) != _NEVER and not ours and not servers:
        raise ConfigError("--tls-ca, --tls-cert: found no address with TLS, expected --tls or tls://HOST:PORT")
    return ours, servers


def _with_tls(places: Iterable[tuple[str, int]], usual: bool) -> frozenset[tuple[str, int]]:
    schemes = [(place, getattr(place, "scheme", "")) for place in places]
    return frozenset(place for place, scheme in schemes if scheme == "tls" or (usual and scheme != "tcp"))


def denials(config: Config) -> list[str]:
    """Return the denied messages as lines, with a mark at a name that matches no known type: it might be misspelt."""
    lines = []
    for globs, way in ((config.deny_in, "from"), (config.deny_out, "to")):
        known = [
            glob if any(map(Denials([glob]).type, BODIES)) else f"{glob} (matches no known type)" for glob in globs
        ]
        if known:
            lines.append(f"denied       {way} peers: {', '.join(known)}")
    return lines
