"""The options of a replay: one table, for ``igtl-gateway replay`` and for ``igtl_gateway.replay_recording``.

A row that the command line alone has is no keyword of the function.  Addresses, TLS and faults are rows of ``bridge``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

from igtl_gateway.app import bridge_options
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.versions import Self
from igtl_gateway.config.faults import CLOCK_STEP, Faults
from igtl_gateway.config.notations import STREAM
from igtl_gateway.config.setting import CLIENTS, NONE, Setting, by_name, changed, check_effect, grouped
from igtl_gateway.config.settings import ABSENT, BY_SETTING, PROFILE_NAMES, TLS
from igtl_gateway.convert.profiles import AUTO
from igtl_gateway.edges.tcp import TlsFiles
from igtl_gateway.replay.playback import checked_rate
from igtl_gateway.replay.restamp import MODES, Mode
from igtl_gateway.replay.simclock import DEFAULT_HZ

Address = tuple[str, int]
To = Literal["igtl", "ros", "both"]
#: Whose messages a replay sends: those of the peers or nodes, those of the gateway, or both; "": by default.
Side = Literal["", "peers", "gateway", "both"]
SIDES: tuple[Side, ...] = get_args(Side)

#: What a setting may need beside other settings: a side of the replay.
_PEERS, _ROS = "OpenIGTLink peers", "ROS"
#: Such a need → what to report if it is not there.
_ABSENT = {
    CLIENTS: ABSENT[CLIENTS],
    _PEERS: "found --to ros, expected --to igtl or --to both",
    _ROS: "found --to igtl, expected --to ros or --to both",
}

#: A year: longer than a session, shorter than what a clock of the system cannot wait for.
_LONGEST_S = 366 * 86_400.0


def _of_a_bridge(name: str, new_name: str = "", needs: tuple[str, ...] = (_PEERS,)) -> Setting:
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
    _of_a_bridge("allow", needs=(_PEERS, CLIENTS)),
    *(replace(BY_SETTING[name], table=NONE, keyword=False, needs=(_PEERS, *BY_SETTING[name].needs)) for name in TLS),
)
_FORMS = (
    Setting(
        "profile",
        AUTO,
        "profile of all OpenIGTLink peers: messages that it cannot read are adapted or left out",
        choices=PROFILE_NAMES,
        shown=f"{AUTO}, detected from their messages",
        needs=(_PEERS,),
        instead="form",
    ),
    Setting(
        "exact",
        False,
        "send the recorded bytes, also those at which a peer may lose the stream",
        needs=(_PEERS,),
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
        needs=(_ROS,),
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """The options of a replay as it uses them; those that are not here are the values of their rows in ``REPLAY``.

    Attributes:
        tls: files for TLS.
        tls_listen, tls_connect: the addresses that use TLS.
        side: whose messages are sent; "": the default of the target.
        config: configuration file to use with ``through_gateway``, instead of the recorded configuration.
        rate: recorded seconds per second; None: no pauses.
        paused: start paused.
        ros_args: arguments of ROS for the node, from ``--ros-args`` on.
    """

    to: To
    listen: tuple[Address, ...]
    connect: tuple[Address, ...]
    allow: tuple[str, ...]
    tls: TlsFiles
    tls_listen: frozenset[Address]
    tls_connect: frozenset[Address]
    profile: str
    exact: bool
    start: str | None
    end: str | None
    duration: float | None
    streams: tuple[str, ...]
    side: Side
    send: tuple[str, ...]
    through_gateway: bool
    config: Path | None
    restamp: Mode
    rate: float | None
    lock_step: bool
    loop: bool
    paused: bool
    delay_s: float
    wait_peers: int | None
    clock_hz: float | None
    fault: str
    seed: int
    digest: bool
    ros_args: tuple[str, ...]

    @classmethod
    def of(cls, values: Mapping[str, Any], ros_args: tuple[str, ...] = ()) -> Self:
        """Return the options for the values of all rows.

        Raises:
            ConfigError: options that contradict each other, or have no effect.
        """
        peers, ros = values["to"] != "ros", values["to"] != "igtl"
        met = {_PEERS: peers, _ROS: ros, CLIENTS: bool(values["listen"]) or not values["connect"]}
        check_effect(by_name(REPLAY), values, changed(by_name(REPLAY), values), met, _ABSENT)
        if ros_args and not ros:
            raise ConfigError(f"--ros-args: {_ABSENT[_ROS]}: the option has no effect here")
        listen, connect = bridge_options.addresses(values["listen"], values["connect"]) if peers else ((), ())
        if not (ros or listen) and (values["wait_peers"] or 0) > len(connect):
            raise ConfigError(f"--wait-peers: found {values['wait_peers']}, expected at most {len(connect)}: --connect")
        if values["side"] == "peers" and values["through_gateway"]:
            raise ConfigError("--side peers: found --through-gateway, which computes messages of the gateway")
        tls_listen, tls_connect = bridge_options.secured(values, listen, connect)
        used = {each.name for each in fields(cls)}
        same: dict[str, Any] = {name: value for name, value in values.items() if name in used}
        faults = Faults.parse(values["fault"])
        if faults.clock_step_ns and values["restamp"] == "now":
            raise ConfigError(
                f"--fault: {CLOCK_STEP}: found --restamp now, which replaces all stamps, expected keep or shift"
            )
        same |= {
            "listen": listen,
            "connect": connect,
            "tls": bridge_options.tls(values),
            "tls_listen": tls_listen,
            "tls_connect": tls_connect,
            "config": Path(values["config"]) if values["config"] else None,
            "rate": checked_rate(None if values["as_fast_as_possible"] or values["lock_step"] else values["rate"]),
            "paused": values["step"] or values["start_paused"],
            "ros_args": ros_args,
        }
        return cls(**same)
