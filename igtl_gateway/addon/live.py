"""What runs: a bridge and its recording, replays, and a server of pages beside them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.app.bridge import Bridge as Bridge
    from igtl_gateway.app.note_rate import Event as NoteEvent
    from igtl_gateway.app.note_rate import NoteRate as NoteRate
    from igtl_gateway.app.player import Player as Player
    from igtl_gateway.app.recording import ACTIONS as RECORDING_ACTIONS
    from igtl_gateway.app.replay_options import ReplayOptions as ReplayOptions
    from igtl_gateway.app.replay_plan import plan_replay as plan_replay
    from igtl_gateway.app.replay_settings import REPLAY as REPLAY_SETTINGS
    from igtl_gateway.app.replay_settings import SIDES as REPLAY_SIDES
    from igtl_gateway.app.replay_settings import Side as ReplaySide
    from igtl_gateway.app.replay_sides import ReplaySides as ReplaySides
    from igtl_gateway.app.replaying import ReplayEvents as ReplayEvents
    from igtl_gateway.app.replaying import run_replay as run_replay
    from igtl_gateway.edges.tcp.http_server import Handler as Handler
    from igtl_gateway.edges.tcp.http_server import LocalServer as LocalServer
    from igtl_gateway.edges.tcp.tls import TlsFiles as TlsFiles
    from igtl_gateway.gateway.diagnostics import RHYTHM_HZ as RHYTHM_HZ
    from igtl_gateway.gateway.diagnostics import SILENT_NS as SILENT_NS
    from igtl_gateway.gateway.silences import Arrivals as Arrivals

#: Names that are others there; the rest of the group is above.
__all__ = ["RECORDING_ACTIONS", "REPLAY_SETTINGS", "REPLAY_SIDES", "NoteEvent", "ReplaySide"]

HOMES: Homes = (
    # A bridge, and the states of its streams
    ("app.bridge", "Bridge"),
    ("app.note_rate", "NoteEvent=Event NoteRate"),
    ("app.recording", "RECORDING_ACTIONS=ACTIONS"),
    ("gateway.diagnostics", "RHYTHM_HZ SILENT_NS"),
    ("gateway.silences", "Arrivals"),
    # Replays
    ("app.player", "Player"),
    ("app.replay_options", "ReplayOptions"),
    ("app.replay_settings", "REPLAY_SETTINGS=REPLAY REPLAY_SIDES=SIDES ReplaySide=Side"),
    ("app.replay_plan", "plan_replay"),
    ("app.replay_sides", "ReplaySides"),
    ("app.replaying", "ReplayEvents run_replay"),
    # Pages for browsers of this host, or over TLS
    ("edges.tcp.http_server", "Handler LocalServer"),
    ("edges.tcp.tls", "TlsFiles"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
