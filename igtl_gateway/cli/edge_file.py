"""The table ``[igtl]`` of a configuration file: the OpenIGTLink side of a bridge, with the names of its options.

::

    [igtl]
    listen = ["127.0.0.1:18944", "tls://0.0.0.0:18945"]
    connect = ["192.168.7.4:18944"]
    allow = ["192.168.7.0/24"]
    tls = false                    # TLS at every address but tcp://HOST:PORT
    tls_cert = "or1.pem"           # files: as seen from the folder of this one
    tls_key = "or1.key"
    tls_ca = "clinic.pem"
    max_clients = 32
    queue_mib = 64
    queue_messages = 4096
    max_body_mib = 256
    max_body = { STRING = 4, "GET_*" = 0.5 }
    max_messages = 50000
    stall_s = 10.0
    min_rate_kib = 8.0
    idle_s = 0.0

Each setting has the name and the meaning of its option; an option on the command line replaces the whole setting.
These settings do not influence the messages of a session, so a recording does not contain them.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from igtl_gateway.cli.admission import limits, peer_address, size_by_type
from igtl_gateway.config import EDGE_TABLE, from_values, read_toml
from igtl_gateway.edges.tcp import PeerLimits
from igtl_gateway.errors import ConfigError

_USUAL = PeerLimits()


@dataclass(frozen=True, slots=True)
class EdgeFile:
    """The settings of the table; see the module.  The defaults are those of the options."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    allow: tuple[str, ...] = ()
    tls: bool = False
    tls_cert: str = ""
    tls_key: str = ""
    tls_ca: str = ""
    max_clients: int = _USUAL.max_clients
    queue_mib: int = _USUAL.queue_bytes >> 20
    queue_messages: int = _USUAL.queue_messages
    max_body_mib: int = _USUAL.max_body >> 20
    max_body: tuple[str, ...] = ()
    max_messages: int = _USUAL.messages_per_s
    stall_s: float = _USUAL.stall_s
    min_rate_kib: float = _USUAL.min_rate / 2**10
    idle_s: float = _USUAL.idle_s

    @classmethod
    def read(cls, path: Path) -> EdgeFile:
        """The table of a file; the usual settings where there is none.  Raises ConfigError with file and setting."""
        table = read_toml(path).get(EDGE_TABLE, {})
        try:
            if not isinstance(table, Mapping):
                raise ConfigError(f"found {EDGE_TABLE} = {table!r}, expected a table [{EDGE_TABLE}]")
            made = from_values(EDGE_TABLE, cls, dict(table) | _sizes(table))
            limits(argparse.Namespace(**made.values(path.parent)))
            return made
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None

    def values(self, folder: Path) -> dict[str, Any]:
        """As the options have them, with files as seen from a folder.  Raises ConfigError."""
        made = {each.name: getattr(self, each.name) for each in fields(self)}
        for name in ("listen", "connect"):
            made[name] = [_parsed(f"{name}[{index}]", peer_address, text) for index, text in enumerate(made[name])]
        made["allow"] = list(self.allow)
        made["max_body"] = [_parsed("max_body", size_by_type, text) for text in self.max_body]
        return made | {name: folder / file if (file := getattr(self, name)) else None for name in _FILES}


_FILES = ("tls_cert", "tls_key", "tls_ca")


def with_file_settings(options: argparse.Namespace, path: Path | None) -> argparse.Namespace:
    """The options with what the command line leaves open: by the file, or as usual.  Raises ConfigError."""
    values = EdgeFile.read(path).values(path.parent) if path else EdgeFile().values(Path())
    given = vars(options)
    return argparse.Namespace(**given | {name: value for name, value in values.items() if _is_open(given[name])})


def _is_open(value: Any) -> bool:
    """Whether an option was not given; 0 is something."""
    return value is None or value is False or value == []


def _sizes(table: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """``max_body`` as its option has it."""
    sizes = table.get("max_body", {})
    if not isinstance(sizes, Mapping):
        raise ConfigError(f"{EDGE_TABLE}.max_body: found {sizes!r}, expected a table such as {{ STRING = 4 }}")
    return {"max_body": tuple(f"{name}={mib}" for name, mib in sizes.items())}


def _parsed(setting: str, parse: Any, text: str) -> Any:
    try:
        return parse(text)
    except argparse.ArgumentTypeError as error:
        raise ConfigError(f"{EDGE_TABLE}.{setting}: {error}") from None
