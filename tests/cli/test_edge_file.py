"""The configuration table of the OpenIGTLink side, together with the options of the command line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from igtl_gateway.cli import admission, edge_file
from igtl_gateway.cli.edge_file import with_file_settings
from igtl_gateway.cli.options import addresses
from igtl_gateway.config import Config
from igtl_gateway.edges.tcp import PeerLimits, TlsFiles
from igtl_gateway.errors import ConfigError
from tests.cli.test_admission import parsed
from tests.integration.bridge import ROOT, Bridge, RawPeer, string

EXAMPLE = ROOT / "examples" / "operating-room.toml"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "or.toml"


def test_every_option_has_its_setting_and_the_other_way_round(path: Path) -> None:
    """The table in the module's own words is one that is accepted, and names all."""
    told = edge_file.__doc__ or ""
    path.write_text(re.sub("(?m)^    ", "", told[told.index("    [igtl]") : told.index("Each setting has")]))
    found = with_file_settings(parsed(), path)
    assert addresses(found) == ((("127.0.0.1", 18944), ("0.0.0.0", 18945)), (("192.168.7.4", 18944),))
    ours, servers = admission.secured(found, *addresses(found))
    assert (ours, servers) == (frozenset({("127.0.0.1", 18944), ("0.0.0.0", 18945)}), frozenset())
    assert found.allow == ["192.168.7.0/24"]
    assert admission.tls(found) == TlsFiles(*(path.parent / name for name in ("or1.pem", "or1.key", "clinic.pem")))
    assert admission.limits(found) == PeerLimits(bodies=(("STRING", 4 << 20), ("GET_*", 1 << 19)))
    options = set(vars(parsed()))
    assert options == set(edge_file.EdgeFile.__slots__) == set(re.findall(r"(?m)^(\w+) =", path.read_text()))


def test_the_command_line_goes_before_the_file_setting_by_setting(path: Path) -> None:
    path.write_text('[igtl]\nlisten = [":1", ":2"]\nallow = ["10.0.0.0/8"]\nidle_s = 60\nstall_s = 5\ntls = true\n')
    found = with_file_settings(parsed("--listen", ":3", "--connect", ":4", "--idle-s", "0"), path)
    assert addresses(found) == ((("127.0.0.1", 3),), (("127.0.0.1", 4),))
    assert (found.allow, found.idle_s, found.stall_s, found.tls) == (["10.0.0.0/8"], 0.0, 5.0, True)


def test_the_session_does_not_know_of_it(path: Path) -> None:
    path.write_text('[gateway]\nbase_frame = "room"\n[igtl]\nmax_clients = 2\n')
    assert Config.from_toml(path) == Config(base_frame="room")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[igtl]\nmax_client = 2", "igtl.max_client: unknown setting, expected one of listen, connect"),
        ("[igtl]\nmax_clients = '2'", "igtl.max_clients: found '2', expected an integer"),
        ("[igtl]\nmax_clients = 0", "limit max_clients: found 0, expected more than 0"),
        ("[igtl]\nlisten = ':1'", "igtl.listen: found ':1', expected strings such as"),
        ("[igtl]\nlisten = ['http://:1']", "igtl.listen[0]: found 'http://:1', expected tls://HOST:PORT"),
        ("[igtl]\nmax_body = 4", "igtl.max_body: found 4, expected a table such as { STRING = 4 }"),
        ("[igtl]\nmax_body = { STRING = -1 }", "igtl.max_body: found 'STRING=-1', expected TYPE=MIB"),
        ("igtl = 4", "found igtl = 4, expected a table [igtl]"),
        ("[edge]\nlisten = []", "found [edge], expected [gateway], [host], [igtl], [[peers]]"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(path: Path, text: str, words: str) -> None:
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        with_file_settings(parsed(), path)
        Config.from_toml(path)
    assert str(error.value).startswith(f"{path}: {words}")


def test_the_example_is_one() -> None:
    found = with_file_settings(parsed(), EXAMPLE)
    assert Config.from_toml(EXAMPLE).deny_in and found.allow and admission.limits(found) != PeerLimits()
    admission.secured(found, *addresses(found))


def test_a_bridge_keeps_to_it(path: Path) -> None:
    path.write_text('[igtl]\nlisten = ["127.0.0.1:0"]\nmax_clients = 1\nmax_body = { STRING = 0.001 }\n')
    bridge = Bridge("--no-ros", "--config", str(path), listen=False)
    try:
        (place,) = bridge.events[0]["listen"]
        with RawPeer(place["port"]) as first, RawPeer(place["port"]) as second:
            assert second.closed_by_peer() or first.closed_by_peer()
            told = bridge.wait_code("refused")
            assert "1 clients are connected already" in json.dumps(told)
        with RawPeer(place["port"]) as peer:
            bridge.wait_code("link_up", 2)
            peer.send(string("x" * 2000))
            bridge.wait_code("too_large")
        assert bridge.end().code == 0
    finally:
        bridge.close()
