"""Codes of the notes in a session that add-ons act on, and words for their reasons."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.gateway import LINK_DOWN as LINK_DOWN
    from igtl_gateway.gateway import LINK_UP as LINK_UP
    from igtl_gateway.gateway import LISTENED as LISTENED
    from igtl_gateway.gateway import PARTNER as PARTNER
    from igtl_gateway.gateway import TICK as TICK
    from igtl_gateway.gateway.diagnostics import HARMLESS as HARMLESS
    from igtl_gateway.gateway.dialogue.clocks import ASK_CLOCK as ASK_CLOCK
    from igtl_gateway.gateway.dialogue.clocks import REPORT as REPORT_CLOCK
    from igtl_gateway.gateway.log.changes import SETTING as SETTING
    from igtl_gateway.gateway.log.changes import SETTINGS as SETTINGS
    from igtl_gateway.gateway.log.clocksteps import CLOCK_STEP as CLOCK_STEP
    from igtl_gateway.gateway.log.corrections import CORRECTIONS as CORRECTIONS
    from igtl_gateway.gateway.log.corrections import StampCorrection as StampCorrection
    from igtl_gateway.gateway.log.fates import DROPPED as DROPPED
    from igtl_gateway.gateway.log.fates import REFUSED_COMMANDS as REFUSED_COMMANDS
    from igtl_gateway.gateway.log.fates import REFUSED_DEVICE as REFUSED_DEVICE
    from igtl_gateway.gateway.orders import ORDERS as ORDERS
    from igtl_gateway.gateway.orders import UNWRITTEN as UNWRITTEN
    from igtl_gateway.record.reports import PAUSED as PAUSED
    from igtl_gateway.record.reports import RESUMED as RESUMED
    from igtl_gateway.record.triggers import LOSSES as LOSSES

#: Names that are others there; the rest of the group is above.
__all__ = ["REPORT_CLOCK"]

HOMES: Homes = (
    # Links and turns of the gateway
    ("gateway", "LINK_DOWN LINK_UP LISTENED PARTNER TICK"),
    ("gateway.dialogue.clocks", "ASK_CLOCK REPORT_CLOCK=REPORT"),
    # Changes: of settings, of stamps, of the clock
    ("gateway.log.changes", "SETTING SETTINGS"),
    ("gateway.log.corrections", "CORRECTIONS StampCorrection"),
    ("gateway.log.clocksteps", "CLOCK_STEP"),
    # Messages that were refused, dropped or lost
    ("gateway.log.fates", "DROPPED REFUSED_COMMANDS REFUSED_DEVICE"),
    ("gateway.diagnostics", "HARMLESS"),
    ("gateway.orders", "ORDERS UNWRITTEN"),
    ("record.triggers", "LOSSES"),
    # Pauses of the recording
    ("record.reports", "PAUSED RESUMED"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
