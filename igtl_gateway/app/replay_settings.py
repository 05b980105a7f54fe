"""The settings of a replay: one table, for ``igtl-gateway replay`` and for ``igtl_gateway.replay_recording``.

A row that the command line alone has is no keyword of the function.  Addresses, TLS and faults are rows of ``bridge``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

from igtl_gateway.config.notations import STREAM
from igtl_gateway.config.setting import BROWSERS, CLIENTS, NONE, Setting, grouped
from igtl_gateway.config.settings import ABSENT, BY_SETTING, PROFILE_NAMES, TLS
from igtl_gateway.convert.choices import AUTO

To = Literal["igtl", "ros", "both"]
#: Whose messages a replay sends: those of the peers or nodes, those of the gateway, or both; "": by default.
Side = Literal["", "peers", "gateway", "both"]
SIDES: tuple[Side, ...] = get_args(Side)

#: What a replay to ROS does with recorded services and actions.
Calls = Literal["answer", "call", "topics"]
CALLS: tuple[Calls, ...] = get_args(Calls)

#: How stamps in messages are sent; ``replay.restamp`` does it.
MODES = ("keep", "now", "shift")
#: Rate of /clock, in hertz of recorded time, as in ``ros2 bag play``.
DEFAULT_HZ = 40.0

#: What a setting may need beside other settings: a side of the replay.
PEERS, ROS = "OpenIGTLink peers", "ROS"
#: Such a need → what to report if it is not there.
ABSENT_SIDES = {
    CLIENTS: ABSENT[CLIENTS],
    BROWSERS: ABSENT[BROWSERS],
    PEERS: "found --to ros, expected --to igtl or --to both",
    ROS: "found --to igtl, expected --to ros or --to both",
}

#: A year: longer than a session, shorter than what a clock of the system cannot wait for.
_LONGEST_S = 366 * 86_400.0


def _of_a_bridge(name: str, new_name: str = "", needs: tuple[str, ...] = (PEERS,)) -> Setting:
    return replace(BY_SETTING[name], name=new_name or name, table=NONE, needs=needs)


_FIRST = (
    Setting(
        "to",
        "igtl",
        "send to OpenIGTLink peers, to ROS, or to both",
        choices=("igtl", "ros", "both"),
        shown="",
        required=True,
        common=True,
    ),
    Setting("json", False, "print jumps, faults and the result as JSON lines", common=True, keyword=False),
    Setting("digest", True, "compute the SHA-256 of the sent bytes, which delays large images", option="--no-digest"),
)
_ADDRESSES = (
    *map(_of_a_bridge, ("listen", "connect")),
    _of_a_bridge("allow", needs=(PEERS, CLIENTS)),
    _of_a_bridge("allow_origin", needs=(PEERS, BROWSERS)),
    *(replace(BY_SETTING[name], table=NONE, keyword=False, needs=(PEERS, *BY_SETTING[name].needs)) for name in TLS),
)
_FORMS = (
    Setting(
        "profile",
        AUTO,
        "profile of all OpenIGTLink peers: messages that it cannot read are adapted or left out",
        choices=PROFILE_NAMES,
        shown=f"{AUTO}, detected from their messages",
        needs=(PEERS,),
        instead="form",
    ),
    Setting(
        "exact",
        False,
        "send the recorded bytes, also those at which a peer may lose the stream",
        needs=(PEERS,),
        instead="form",
    ),
)
_SELECTION = (
    Setting("start", None, "start at this time", kind=str, metavar="TIME", shown="the beginning", common=True),
    Setting("end", None, "stop after this time", kind=str, metavar="TIME", shown="the end", common=True, instead="end"),
    Setting(
        "duration",
        None,
        "stop after this much recorded time",
        kind=float,
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_LONGEST_S,
        open_ends=True,
        common=True,
        instead="end",
    ),
    Setting("streams", (), f"select streams {STREAM}", metavar="GLOB", common=True),
    Setting(
        "side",
        "",
        "whose messages are sent: those of the gateway; those of the peers, for ROS of its nodes; or both",
        choices=SIDES,
        shown="gateway; peers if it sent only queries, answers and pings; both for ROS",
        common=True,
    ),
    Setting(
        "services",
        "answer",
        "recorded services and actions: answer requests and goals as recorded; call: send the recorded ones at their "
        "times; topics: only publish their topics, as ros2 bag play does",
        choices=CALLS,
        needs=(ROS,),
        common=True,
    ),
    _of_a_bridge("to_igtl", "send", ()),
    Setting(
        "through_gateway",
        False,
        "recompute the outputs from the recorded inputs with this version, and send them",
        common=True,
    ),
    Setting(
        "config",
        None,
        "with --through-gateway: use this configuration (TOML) instead of the recorded one",
        kind=str,
        metavar="FILE",
        needs=("through_gateway",),
    ),
    Setting(
        "restamp",
        "keep",
        "stamps in the messages, at any depth; now: the time of sending; shift: all moved by one offset, so that the "
        "first is now, again after each jump",
        choices=MODES,
        common=True,
    ),
)
_PACE = (
    Setting(
        "rate",
        1.0,
        "recorded seconds per second",
        kind=float,
        metavar="FACTOR",
        shown="1.0",
        common=True,
        instead="pace",
    ),
    Setting("as_fast_as_possible", False, "send without pauses", common=True, instead="pace", keyword=False),
    Setting(
        "lock_step",
        False,
        "send without pauses, one message at a time: wait until the kernel has accepted the message for every peer and "
        "every reliable ROS subscriber has acknowledged it",
        option="--speed-of-light",
        instead="pace",
    ),
    Setting("loop", False, "repeat until stopped", common=True),
    Setting("start_paused", False, "wait for the key or the ROS service to resume", keyword=False),
    Setting(
        "step",
        False,
        "start paused and send one message per → or Enter; without a terminal, per line of standard input",
        common=True,
        keyword=False,
    ),
    Setting(
        "delay_s",
        0.0,
        "wait before the first message",
        option="--delay",
        metavar="SECONDS",
        unit="s",
        least=0,
        most=_LONGEST_S,
        shown="0",
    ),
    Setting(
        "wait_peers",
        None,
        "wait for N connected peers, or for N ROS subscribers on each topic",
        kind=int,
        metavar="N",
        least=0,
        shown="1 peer, 0 subscribers",
    ),
    Setting(
        "clock_hz",
        None,
        "publish the recorded time on /clock at this rate of recorded time",
        option="--clock",
        kind=float,
        metavar="HZ",
        unit="Hz",
        bare=DEFAULT_HZ,
        shown=f"{DEFAULT_HZ:.0f} if HZ is not given",
        needs=(ROS,),
        common=True,
    ),
)
_FAULTS = (
    _of_a_bridge("faults", "fault"),
    _of_a_bridge("fault_seed", "seed", ("fault",)),
)

#: All options of a replay but ``--ros-args``, in the order of the help.
REPLAY: tuple[Setting, ...] = (
    *_FIRST,
    *grouped("addresses and security", *_ADDRESSES),
    *grouped("what the peers can read", *_FORMS),
    *grouped("selection of messages", *_SELECTION),
    *grouped("pace", *_PACE),
    *grouped("fault injection", *_FAULTS),
)
