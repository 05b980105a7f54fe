"""The options that decide which peers are admitted."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from igtl_gateway.cli import admission
from igtl_gateway.cli.admission import peer_address
from igtl_gateway.cli.edge_file import with_file_settings
from igtl_gateway.cli.options import add_addresses, add_allow
from igtl_gateway.config import Config
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.errors import ConfigError


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_addresses(parser, admission.peer_address)
    add_allow(parser)
    admission.add_tls(parser)
    admission.add_limits(parser)
    return parser.parse_args(words)


def test_places() -> None:
    assert (peer_address("tls://[::1]:7"), peer_address("tls://[::1]:7").scheme) == (("::1", 7), "tls")
    assert (peer_address("tcp://:7"), peer_address("tcp://:7").scheme) == (("127.0.0.1", 7), "tcp")
    assert (peer_address("10.0.0.1"), peer_address("10.0.0.1").scheme) == (("10.0.0.1", 18944), "")
    with pytest.raises(argparse.ArgumentTypeError, match="'http://a:1'"):
        peer_address("http://a:1")


@pytest.mark.parametrize(
    ("words", "listen", "connect"),
    [
        ([], "b", "d"),
        (["--tls"], "ab", "cd"),
        (["--tls-cert", "a.pem"], "ab", "d"),  # never in the clear by mistake
        (["--tls-ca", "ca.pem"], "b", "d"),
    ],
)
def test_where_tls_is_spoken(words: list[str], listen: str, connect: str) -> None:
    ours = {"a": peer_address(":1"), "b": peer_address("tls://:2"), "-": peer_address("tcp://:3")}
    servers = {"c": peer_address(":4"), "d": peer_address("tls://:5"), "-": peer_address("tcp://:6")}
    found = admission.secured(parsed(*words), tuple(ours.values()), tuple(servers.values()))
    assert found == (frozenset(ours[name] for name in listen), frozenset(servers[name] for name in connect))


def test_files_for_no_address_are_a_mistake() -> None:
    with pytest.raises(ConfigError, match="found no address with TLS"):
        admission.secured(parsed("--tls-ca", "ca.pem"), (), (peer_address(":1"),))
    assert admission.tls(parsed("--tls-key", "k")) == TlsFiles(None, Path("k"), None)


def test_limits_and_their_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    assert admission.limits(with_file_settings(parsed(), None)) == PeerLimits()
    words = "--max-body STRING=4 --max-body GET_*=0.5 --max-body-mib 1 --max-messages 9 --idle-s 60 --stall-s 1"
    words += " --min-rate-kib 2"
    bodies = (("STRING", 4 << 20), ("GET_*", 1 << 19))
    own = PeerLimits(idle_s=60, stall_s=1, min_rate=2048, max_body=1 << 20, bodies=bodies, messages_per_s=9)
    assert admission.limits(with_file_settings(parsed(*words.split()), None)) == own
    for wrong in ("STRING", "STRING=", "=4", "STRING=-1", "STRING=nan", "STRING=inf"):
        with pytest.raises(SystemExit):
            parsed("--max-body", wrong)
        assert "expected TYPE=MIB such as STRING=4" in capsys.readouterr().err


def test_what_is_denied_is_said_and_slips_are_seen() -> None:
    assert admission.denials(Config()) == []
    lines = admission.denials(Config(deny_in=("command", "TRANFORM"), deny_out=("*",)))
    assert lines == ["denied       from peers: command, TRANFORM (matches no known type)", "denied       to peers: *"]
