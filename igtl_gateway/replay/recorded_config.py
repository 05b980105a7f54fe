"""The configuration that a recording is replayed, verified and compared with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from igtl_gateway.base.errors import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.config.configuration import Config
from igtl_gateway.record.sessionfile import facts


def config_to_run(session: Mapping[str, str], path: Path | None = None) -> Config:
    """Return the configuration of the file ``path`` if it is given, else the recorded one.

    Raises ConfigError for an invalid file, UnsupportedRecording if the recorded configuration cannot be used.
    """
    given = Config.from_toml(path) if path else None
    try:
        recorded = Config.from_dict(facts.configuration(session))
        # without a setting in the file for what is older than a recording, the recorded setting applies
        return given.as_live_as(recorded) if given else recorded
    except (ConfigError, DamagedRecording) as error:
        if given:
            return given
        raise UnsupportedRecording(f"the recorded configuration cannot be used: {error}") from None
