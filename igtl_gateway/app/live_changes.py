"""Settings that change while a bridge runs: each change is an input of its session."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import nullcontext

from igtl_gateway.app.hub import Hub
from igtl_gateway.config.configuration import Config
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.gateway.live_settings import LiveSettings


class LiveChanges:
    """A part: the settings of a bridge that may change, and the parameters of its node that show and change them.

    Args:
        config: has the values of the start.
        hub: takes the changes as notes.
        side: has the parameters; None: there are none.

    Attributes:
        settings: as they are now.
    """

    def __init__(self, config: Config, hub: Hub, side: RosSide | None) -> None:
        self.settings = LiveSettings.of(config)
        self._hub = hub
        self._side = side
        self._lock = threading.Lock()

    def start(self) -> None:
        """Follow the parameters."""
        if self._side:
            self._side.follow(self._apply)

    def stop(self) -> None:
        """Follow them no more: they wait for the next bridge."""
        if self._side:
            self._side.follow(None)

    def change(self, changes: Mapping[str, object]) -> None:
        """Change settings and parameters; see ``Bridge.change``."""
        with self._side.changing if self._side else nullcontext():
            self._apply(changes)
            if self._side:
                self._side.show({name: getattr(self.settings, name) for name in changes})

    def _apply(self, changes: Mapping[str, object]) -> None:
        """Change settings; the parameters of the node have changed already, or change afterwards."""
        with self._lock:
            settings = self.settings.changed(changes)
            if settings != self.settings:
                self._hub.note(settings.note(self.settings))
                self.settings = settings
