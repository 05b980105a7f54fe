"""How the settings of Zenoh are written: the way to the ROS graph, endpoints, sites and classes of streams."""

from __future__ import annotations

import re

from igtl_gateway.addon import ConfigError, one_of
from igtl_gateway.addon.settings import DDS

ZENOH = "zenoh"
#: Classes of streams between sites.
SITE_CLASSES = ("commands", "poses", "data", "pictures")
#: Where a router of Zenoh usually is, and where one listens.
ZENOH_ENDPOINT = "tcp/localhost:7447"
ZENOH_LISTEN = "tcp/127.0.0.1:7447"

#: Protocol and place; options of the protocol may follow.
_ENDPOINT = re.compile(
    r"([a-z][a-z0-9_-]*/)?(?:[^/\s:#?;\[\]]+|\[[0-9a-fA-F:.%]+\]):[0-9]{1,5}(?:[#?;]\S*)?|(unixsock-stream|unixpipe)/\S+",
    re.ASCII,
)


def ros_middleware(text: str) -> str | None:
    """Parse ``dds`` or ``zenoh[:ENDPOINT]``; return the endpoint of the router, None for DDS.

    "": no endpoint is given; Zenoh's configuration has it, or the usual one counts.

    ``zenoh:HOST:PORT`` stands for ``zenoh:tcp/HOST:PORT``.
    """
    name, colon, endpoint = text.partition(":")
    if text == DDS:
        return None
    try:
        if name == ZENOH:
            return zenoh_endpoint(endpoint) if colon else ""
    except ConfigError:
        pass
    raise ConfigError(f"found {text!r}, expected {DDS}, {ZENOH} or {ZENOH}:ENDPOINT such as {ZENOH}:{ZENOH_ENDPOINT}")


def zenoh_endpoint(text: str) -> str:
    """Return an endpoint such as ``tls/host:7447``; ``HOST:PORT`` stands for ``tcp/HOST:PORT``."""
    found = _ENDPOINT.fullmatch(text)
    if not found:
        raise ConfigError(f"found {text!r}, expected PROTOCOL/HOST:PORT such as {ZENOH_ENDPOINT}")
    return text if found[1] or found[2] else f"tcp/{text}"


def site_name(text: str) -> str:
    """Return the name of a site: letters, digits, ``_`` and ``-``."""
    if text and not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text):
        raise ConfigError(f"found {text!r}, expected up to 64 letters, digits, _ and -")
    return text


def site_class(text: str) -> tuple[str, str]:
    """Parse ``GLOB=CLASS``."""
    glob, _, name = text.rpartition("=")
    if not glob or name not in SITE_CLASSES:
        raise ConfigError(f"found {text!r}, expected GLOB=CLASS with {one_of(name, SITE_CLASSES)}")
    return glob, name
