"""The options of a replay as it uses them; ``replay_settings`` has the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from igtl_gateway.app import bridge_options
from igtl_gateway.app.replay_settings import ABSENT_SIDES, PEERS, REPLAY, ROS, Calls, Side, To
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.versions import Self
from igtl_gateway.config.faults import CLOCK_STEP, Faults
from igtl_gateway.config.notations import uses_websocket
from igtl_gateway.config.setting import BROWSERS, CLIENTS, by_name, changed, check_effect
from igtl_gateway.edges.tcp import TlsFiles
from igtl_gateway.replay.playback import checked_rate
from igtl_gateway.replay.restamp import Mode

Address = tuple[str, int]


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
    allow_origin: tuple[str, ...]
    tls: TlsFiles
    tls_listen: frozenset[Address]
    tls_connect: frozenset[Address]
    profile: str
    exact: bool
    services: Calls
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
        met = {PEERS: peers, ROS: ros, CLIENTS: bool(values["listen"]) or not values["connect"]}
        met[BROWSERS] = any(map(uses_websocket, values["listen"]))
        check_effect(by_name(REPLAY), values, changed(by_name(REPLAY), values), met, ABSENT_SIDES)
        if ros_args and not ros:
            raise ConfigError(f"--ros-args: {ABSENT_SIDES[ROS]}: the option has no effect here")
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
