"""Options of the bridge about peers: who is let in, how TLS is spoken, what one may cost."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from igtl_gateway.cli.common import address
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
    """``[tls://|tcp://]HOST:PORT``, the rest as ``common.address``."""
    scheme, found, rest = text.partition("://")
    if found and scheme not in ("tls", "tcp"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected tls://HOST:PORT, tcp://HOST:PORT or HOST:PORT")
    made = PeerAddress(address(rest if found else text))
    made.scheme = scheme if found else ""
    return made


def add_tls(parser: argparse.ArgumentParser) -> None:
    """Whether TLS is spoken, and with what."""
    parser.add_argument("--tls-cert", type=Path, metavar="PEM", help="our certificate: --listen speaks TLS then")
    parser.add_argument("--tls-key", type=Path, metavar="PEM", help="its key (default: in the same file)")
    parser.add_argument(
        "--tls-ca", type=Path, metavar="PEM", help="peers must have a certificate of this CA, servers too"
    )
    parser.add_argument(
        "--tls", action="store_true", help="TLS at every address but tcp://HOST:PORT (tls://HOST:PORT: at that one)"
    )


def add_limits(parser: argparse.ArgumentParser) -> None:
    """What a peer may cost; what is not given is None, see ``edge_file``."""
    parser.add_argument(
        "--queue-mib", type=int, metavar="MIB", help=f"send queue of a peer ({_USUAL.queue_bytes >> 20})"
    )
    parser.add_argument(
        "--queue-messages", type=int, metavar="N", help=f"send queue of a peer ({_USUAL.queue_messages})"
    )
    parser.add_argument("--max-clients", type=int, metavar="N", help=f"peers at once ({_USUAL.max_clients})")
    parser.add_argument(
        "--max-body-mib", type=int, metavar="MIB", help=f"longest message accepted ({_USUAL.max_body >> 20})"
    )
    parser.add_argument(
        "--max-body",
        type=size_by_type,
        action="append",
        default=[],
        metavar="TYPE=MIB",
        help="the same of a type (or 'GET_*'); strings and poses may have 2, lists 16, VIDEO 64; may be repeated",
    )
    parser.add_argument(
        "--max-messages",
        type=int,
        metavar="N",
        help=f"read from one peer in a second; one that sends more has to wait ({_USUAL.messages_per_s})",
    )
    parser.add_argument(
        "--stall-s", type=float, metavar="S", help=f"longest silence inside a message ({_USUAL.stall_s:g})"
    )
    parser.add_argument(
        "--min-rate-kib",
        type=float,
        metavar="KIB",
        help=f"least speed of a message, per second ({_USUAL.min_rate / 2**10:g})",
    )
    parser.add_argument(
        "--idle-s", type=float, metavar="S", help="close a link that is silent both ways so long (0: no)"
    )


def size_by_type(text: str) -> tuple[str, int]:
    """``TYPE=MIB``: the type, and bytes."""
    name, equals, number = text.partition("=")
    try:
        if name and equals and (mib := float(number)) > 0:
            return name, round(mib * 2**20)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"found {text!r}, expected TYPE=MIB such as STRING=4")


def limits(options: argparse.Namespace) -> PeerLimits:
    """What a peer may cost.  Raises ConfigError."""
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
    """The files of TLS."""
    return TlsFiles(options.tls_cert, options.tls_key, options.tls_ca)


def secured(
    options: argparse.Namespace, listen: Sequence[tuple[str, int]], connect: Sequence[tuple[str, int]]
) -> tuple[frozenset[tuple[str, int]], frozenset[tuple[str, int]]]:
    """The addresses where TLS is spoken: of ours, and of servers.  Raises ConfigError for files that are for none.

    A certificate is for the addresses where we are the server, unless one says ``tcp://``: who has given one must not
    find out later that all went in the clear.
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
    """What is denied, as lines; a name that stands for no known type may be a slip of the pen."""
    lines = []
    for globs, way in ((config.deny_in, "from"), (config.deny_out, "to")):
        known = [glob if any(map(Denials([glob]).type, BODIES)) else f"{glob} (no type known here)" for glob in globs]
        if known:
            lines.append(f"denied       {way} peers: {', '.join(known)}")
    return lines
