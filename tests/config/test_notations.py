"""How addresses, networks, sizes and CPUs are written."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from igtl_gateway.addons.zenoh import notation
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.realtime import cpus_text
from igtl_gateway.config import notations
from igtl_gateway.config.notations import peer_address
from tests.tables import table


def test_addresses() -> None:
    assert (peer_address("tls://[::1]:7"), peer_address("tls://[::1]:7").scheme) == (("::1", 7), "tls")
    assert (peer_address("tcp://:7"), peer_address("tcp://:7").scheme) == (("127.0.0.1", 7), "tcp")
    assert (peer_address("10.0.0.1"), peer_address("10.0.0.1").scheme) == (("10.0.0.1", 18944), "")
    schemes = ["ws", "wss", "tls"]
    assert [notations.listen_address(f"{scheme}://:7").scheme for scheme in schemes] == schemes
    assert notations.address("[::1]") == ("::1", 18944)


@table(
    ("read", "text", "value"),
    [
        (notations.network, "192.168.7.0/24", "192.168.7.0/24"),
        (notations.network, "any", "any"),
        (notations.size_by_type, "GET_*=0.5", ("GET_*", 1 << 19)),
        *((notations.origin, each, each) for each in ("*", "null", "http://[::1]:80", "https://a.b")),
        (notations.type_glob, "GET_*", "GET_*"),
        (notations.key_value, "operator=A=B", ("operator", "A=B")),
        (notation.ros_middleware, "dds", None),
        (notation.ros_middleware, "zenoh", ""),
        (notation.ros_middleware, "zenoh:robot:7447", "tcp/robot:7447"),
        (notation.ros_middleware, "zenoh:tls/[::1]:7447", "tls/[::1]:7447"),
        (notation.zenoh_endpoint, "tcp/0.0.0.0:7447#iface=eth0", "tcp/0.0.0.0:7447#iface=eth0"),
        (notation.zenoh_endpoint, "unixsock-stream//run/zenoh", "unixsock-stream//run/zenoh"),
        (notations.cpus, "2,4-6", frozenset({2, 4, 5, 6})),
        (notations.cpus, " 3 , 1-1", frozenset({1, 3})),
        (notations.cpus, "0-2,2", frozenset({0, 1, 2})),
    ],
)
def test_what_is_read(read: Callable[[str], object], text: str, value: object) -> None:
    assert read(text) == value


@table(
    ("read", "texts", "expected"),
    [
        (notations.address, ("a:70000", "a:b", ":-1"), "HOST:PORT with a port from 0 to 65535"),
        (peer_address, ("http://a:1",), "tls://HOST:PORT, tcp://HOST:PORT or HOST:PORT"),
        (peer_address, ("ws://a:1",), "no ws://: only --listen of bridge and replay takes it"),
        (
            notations.listen_address,
            ("http://a:1",),
            "tls://HOST:PORT, tcp://HOST:PORT, ws://HOST:PORT, wss://HOST:PORT",
        ),
        (
            notations.origin,
            ("viewer", "http://", "http://a/", "ftp://a", "http://a:b", "http://a:65536", "https://a b", ""),
            "an origin such as https://viewer.clinic:8443, null or *",
        ),
        (notations.network, ("all", "10.0.0.0/64", ""), "a network such as 192.168.7.0/24, or any"),
        (notations.size_by_type, ("STRING", "STRING=", "=4", "STRING=-1", "STRING=nan", "STRING=inf"), "TYPE=MIB"),
        (notations.type_glob, ("", "A B", "É", "A/B"), "a type or a glob such as COMMAND, GET_*"),
        (notations.key_value, ("a", "=b"), "KEY=VALUE"),
        (
            notation.ros_middleware,
            ("", "rmw", "zenoh:", "zenoh:x", "zenoh:tcp/", "dds:x", "zenoh:/a:1"),
            "dds, zenoh or zenoh:",
        ),
        (notation.zenoh_endpoint, ("", "host", "tcp/host", "tcp/:7447", "host:x", "tcp/a b:1"), "PROTOCOL/HOST:PORT"),
        (notations.cpus, ("all", "", "1,,2", "-1", "1-", "a-b", "²"), "CPUs such as 2,4-6"),
        (notations.cpus, ("9000", "5-2", "0-99999"), "CPUs in ascending order, up to 8191"),
    ],
)
def test_what_is_refused(read: Callable[[str], object], texts: tuple[str, ...], expected: str) -> None:
    for text in texts:
        with pytest.raises(ConfigError) as error:
            read(text)
        assert str(error.value).startswith(f"found {text!r}, expected {expected}")


def test_cpus_are_written_as_they_are_read() -> None:
    assert notations.cpus(cpus_text({6, 4, 5, 2, 0})) == {0, 2, 4, 5, 6}


@pytest.mark.parametrize("name", ["a.mcap", "A.MCAP", "long", "day.2", "2026-11-23.or1", ".hidden", "folder.bag/out"])
def test_a_recording_may_have_these_names(name: str) -> None:
    assert notations.recording_name(name) == name


@pytest.mark.parametrize("name", ["out.bag", "x/out.db3", "star.PNG", "a.rrd", "a.mcap.zst", "bag.yaml"])
def test_a_recording_with_the_name_of_another_format_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"found '.*', the name of .*, expected a recording \(MCAP\): \*\.mcap"):
        notations.recording_name(name)
