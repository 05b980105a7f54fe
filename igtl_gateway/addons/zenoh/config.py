"""The configuration of a Zenoh session: our defaults, the user's file, the endpoint, the overrides of ROS.

``ZENOH_SESSION_CONFIG_URI`` names a file and ``ZENOH_CONFIG_OVERRIDE`` has single values, as for ROS with rmw_zenoh.
The order is: defaults or file, then the endpoint that the user gave, then the overrides.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import check_nesting, files, limits, whole_number
from igtl_gateway.addons.zenoh.library import first_line, import_zenoh
from igtl_gateway.addons.zenoh.notation import ZENOH_ENDPOINT

SESSION_FILE, OVERRIDE, DOMAIN = "ZENOH_SESSION_CONFIG_URI", "ZENOH_CONFIG_OVERRIDE", "ROS_DOMAIN_ID"
_MAX_DOMAIN = 232
_MOST_ENDPOINTS = 256

#: As in ROS, but as a client: a peer on another machine receives nothing through the router of ROS.
_SESSION: dict[str, Any] = {
    "mode": "client",
    "connect/endpoints": [ZENOH_ENDPOINT],
    "connect/retry": {"period_init_ms": 250, "period_max_ms": 2000, "period_increase_factor": 2},
    "scouting/multicast/enabled": False,
    "timestamping/enabled": True,
}
#: Files that TLS needs, each to be checked by us: Zenoh only reports that it cannot connect.
_FILES = (
    "root_ca_certificate",
    "connect_private_key",
    "connect_certificate",
    "listen_private_key",
    "listen_certificate",
)


def session_config(endpoint: str = "", environ: Mapping[str, str] = os.environ) -> Any:
    """Return the configuration (zenoh.Config) of a session.

    Args:
        endpoint: of the router, such as ``tcp/localhost:7447``; "": that of the file or the default.
        environ: the environment.

    Raises:
        RosError: Zenoh is not installed.
        ConfigError: a file or a value that Zenoh refuses; a file of TLS that is missing.
    """
    return made(_SESSION, SESSION_FILE, {"connect/endpoints": [endpoint]} if endpoint else {}, environ)


def made(defaults: Mapping[str, Any], variable: str, given: Mapping[str, Any], environ: Mapping[str, str]) -> Any:
    """Return a configuration of defaults (or of the file in a variable), given values and the overrides of ROS."""
    zenoh = import_zenoh()
    if path := environ.get(variable):
        _check_document(variable, Path(path))
        try:
            config = zenoh.Config.from_file(path)
        except Exception as error:  # zenoh's class is one for all causes
            raise ConfigError(f"{variable}={path}: {first_line(error)}") from None
    else:
        config = zenoh.Config()
        for name, value in defaults.items():
            config.insert_json5(name, json.dumps(value))
    for name, value in given.items():
        _insert(config, name, json.dumps(value), "--ros zenoh")
    for rule in filter(None, map(str.strip, environ.get(OVERRIDE, "").split(";"))):
        name, equals, text = rule.partition("=")
        if not equals:
            raise ConfigError(f"{OVERRIDE}: found {rule!r}, expected key/path=value;key/path=value")
        _insert(config, name.strip(), text.strip(), OVERRIDE)
    _check_endpoints(config)
    _check_files(config)
    return config


def value_of(config: Any, name: str) -> Any:
    """Return one value of a configuration; None if it has none."""
    try:
        return json.loads(config.get_json(name))
    except Exception:  # zenoh's class is one for all causes; here: a name without a value
        return None


def endpoints_of(config: Any) -> tuple[str, ...]:
    """Return the endpoints that a session connects to."""
    found = value_of(config, "connect/endpoints")
    if isinstance(found, dict):  # by mode
        found = found.get(value_of(config, "mode") or "client")
    return tuple(str(each) for each in found or ())


def domain_of(environ: Mapping[str, str] = os.environ) -> int:
    """Return the number of the ROS domain.  Raises ConfigError."""
    text = environ.get(DOMAIN, "") or "0"
    if (domain := whole_number(text, _MAX_DOMAIN)) is None:
        raise ConfigError(f"{DOMAIN}: found {text!r}, expected a number from 0 to {_MAX_DOMAIN}")
    return domain


def _check_document(variable: str, path: Path) -> None:
    """Raise ConfigError for a file that Zenoh should not read: its parser has no limits, and waits for a FIFO."""
    try:
        data = files.read_bytes(path)
        limits.check_limit("document", len(data), str(path))
        check_nesting(data.decode("utf-8", "replace"), str(path))
    except GatewayError as error:
        raise ConfigError(f"{variable}: {error}") from None


def _insert(config: Any, name: str, json5: str, place: str) -> None:
    try:
        config.insert_json5(name, json5)
    except Exception as error:  # zenoh's class is one for all causes
        raise ConfigError(f"{place}: found {name}={json5}, which Zenoh refuses ({first_line(error)})") from None


def _check_endpoints(config: Any) -> None:
    for name in ("connect/endpoints", "listen/endpoints"):
        found = value_of(config, name)
        for each in found.values() if isinstance(found, dict) else (found,):
            if isinstance(each, list) and len(each) > _MOST_ENDPOINTS:  # Zenoh makes a task for each, and does not end
                raise ConfigError(
                    f"{name}: found {count_text(len(each), 'endpoint')}, expected at most {_MOST_ENDPOINTS}"
                )


def _check_files(config: Any) -> None:
    for name in _FILES:
        path = value_of(config, f"transport/link/tls/{name}")
        if path and not Path(path).is_file():
            raise ConfigError(f"transport/link/tls/{name}: found {path!r}, expected a file that exists")
