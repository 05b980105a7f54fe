"""The options of ``igtl-gateway doctor``."""

from __future__ import annotations

from dataclasses import replace

from igtl_gateway.cli.options import DEFAULT_HOST, DEFAULT_PORT
from igtl_gateway.config import notations
from igtl_gateway.config.setting import Setting, grouped
from igtl_gateway.config.settings import BY_SETTING, TLS

_YEAR_S = 365 * 86_400.0

#: What an option needs: a peer, or an address for it; a recording and this machine have neither.
PEER = "a peer"

OPTIONS = (
    Setting(
        "listen",
        None,
        "wait for the peer to connect to this address",
        kind=str,
        metavar="[tls://]HOST:PORT",
        reads=notations.peer_address,
        bare=f"{DEFAULT_HOST}:{DEFAULT_PORT}",
        shown=f"{DEFAULT_HOST}:{DEFAULT_PORT}",
        needs=(PEER,),
    ),
    Setting(
        "seconds",
        5.0,
        "observe for this time",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_YEAR_S,
        open_ends=True,
        needs=(PEER,),
    ),
    Setting("messages", 0, "stop after this number of messages", metavar="N", least=0, needs=(PEER,)),
    Setting(
        "speak",
        1,
        "send one STATUS with this header version to a peer that sends nothing; 0: send none",
        metavar="VERSION",
        choices=(0, 1, 2),
        needs=(PEER,),
    ),
    Setting(
        "ros",
        False,
        "also look at the ROS graph: topics, types and QoS; with --config also without a peer",
        needs=(PEER,),
    ),
    Setting(
        "host",
        False,
        "check this machine for causes of jitter instead of a peer: kernel, CPUs, timers, limits, memory, clock",
    ),
    Setting("config", "", "configuration of the bridge (TOML)", metavar="FILE"),
    Setting("json", False, "print the result as one JSON object"),
    *grouped("security", *(replace(BY_SETTING[name], needs=(PEER,)) for name in ("allow", *TLS))),
)
