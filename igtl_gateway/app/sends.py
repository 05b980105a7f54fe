"""ROS topics that a user sends to OpenIGTLink, as ``TOPIC=DEVICE:TYPE``."""

from __future__ import annotations

from collections.abc import Sequence

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import Config


def with_sends(config: Config, sends: Sequence[str]) -> Config:
    """Return ``config`` with a first row for each ``TOPIC[=DEVICE[:TYPE]]``.  Raises ConfigError."""
    values = config.to_dict()
    return Config.from_dict(values | {"to_igtl": [*map(send_row, sends), *values["to_igtl"]]})


def send_row(text: str) -> dict[str, str]:
    """Return the row of ``[[to_igtl]]`` for ``TOPIC[=DEVICE[:TYPE]]``.  Raises ConfigError."""
    topic, _, rest = text.partition("=")
    device, _, igtl_type = rest.partition(":")
    if not topic.startswith("/"):
        raise ConfigError(f"--send: found {text!r}, expected /topic, /topic=Device or /topic=Device:TYPE")
    return {"topic": topic, "device": device, "type": igtl_type}
