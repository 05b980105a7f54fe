"""The settings that can change while a session runs, and the note that changes them; see ``session.changes``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import Config, from_values
from igtl_gateway.gateway.log.changes import SETTING, SETTINGS
from igtl_gateway.gateway.log.note import Level, Note


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """The settings that can change, as the configuration has them, and whether messages pass.

    Attributes:
        deny_in, deny_out, kinds, max_age_s: see ``config``.
        active: False: the gateway refuses all messages.
    """

    deny_in: tuple[str, ...] = ()
    deny_out: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    max_age_s: float = 0.0
    active: bool = True

    @classmethod
    def of(cls, config: Config) -> LiveSettings:
        """Return the settings of a session that begins."""
        return cls(config.deny_in, config.deny_out, config.kinds, config.max_age_s)

    @classmethod
    def from_note(cls, note: Note) -> LiveSettings | None:
        """Return the settings in a note; None if it does not change them, or to impossible values."""
        values = note.data.get(SETTINGS)
        if note.code != SETTING or not isinstance(values, dict):
            return None
        try:
            return cls().changed(values)
        except ConfigError:
            return None

    def changed(self, changes: Mapping[str, Any]) -> LiveSettings:
        """Return the settings after changes.  Raises ConfigError with name, value found and value expected."""
        values = dataclasses.asdict(self) | dict(changes)
        settings = from_values("gateway", LiveSettings, values)
        settings.applied(Config())  # checks the values
        return settings

    def applied(self, config: Config) -> Config:
        """Return a configuration with these settings.  Raises ConfigError."""
        return dataclasses.replace(
            config, deny_in=self.deny_in, deny_out=self.deny_out, kinds=self.kinds, max_age_s=self.max_age_s
        )

    def note(self, before: LiveSettings) -> Note:
        """Return the note that changes the settings from ``before`` to these."""
        own, others = dataclasses.asdict(self), dataclasses.asdict(before)
        names = [name for name in own if own[name] != others[name]]
        texts = [f"{name} from {_text(others[name])} to {_text(own[name])}" for name in names]
        return Note(Level.INFO, SETTING, f"changed: {', '.join(texts)}", data={SETTINGS: own})


def _text(value: Any) -> str:
    """Return a value as in a configuration file."""
    return json.dumps(value, ensure_ascii=False)
