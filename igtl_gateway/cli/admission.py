"""Settings of peers: who may connect, TLS, denied messages, limits."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.cli.options import Options
from igtl_gateway.cli.settings import add_settings
from igtl_gateway.config import Config
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.errors import ConfigError
from igtl_gateway.gateway.denials import Denials
from igtl_gateway.notations import size_by_type
from igtl_gateway.wire.registry import BODIES

_NEVER = TlsFiles()


def add_tls(group: Options) -> None:
    """Options for TLS and its files."""
    add_settings(group, "tls", "tls_cert", "tls_key", "tls_ca")


def limits(values: Mapping[str, Any]) -> PeerLimits:
    """Return the limits of a peer.  Raises ConfigError."""
    return PeerLimits(
        max_clients=values["max_clients"],
        queue_bytes=values["queue_mib"] << 20,
        queue_messages=values["queue_messages"],
        stall_s=values["stall_s"],
        min_rate=round(values["min_rate_kib"] * 2**10),
        idle_s=values["idle_s"],
        max_body=values["max_body_mib"] << 20,
        bodies=tuple(map(size_by_type, values["max_body"])),
        messages_per_s=values["max_messages"],
    )


def tls(values: Mapping[str, Any]) -> TlsFiles:
    """Return the files of TLS."""
    return TlsFiles(*(Path(values[name]) if values[name] else None for name in ("tls_cert", "tls_key", "tls_ca")))


def secured(
    values: Mapping[str, Any], listen: Sequence[tuple[str, int]], connect: Sequence[tuple[str, int]]
) -> tuple[frozenset[tuple[str, int]], frozenset[tuple[str, int]]]:
    """Return the addresses with TLS: (listening, servers).  Raises ConfigError for files without such an address.

    A certificate turns TLS on for all listening addresses except those with ``tcp://``: a user who gives one must not
    discover later that the traffic was not encrypted.
    """
    ours = _with_tls(listen, values["tls"] or bool(values["tls_cert"]))
    servers = _with_tls(connect, values["tls"])
    if tls(values) != _NEVER and not ours and not servers:
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
