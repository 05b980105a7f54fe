"""Whose pages may connect."""

from __future__ import annotations

from igtl_gateway.edges.tcp.websocket.origins import Origins
from tests.tables import table

NAMED = ("https://viewer.clinic", "http://viewer.clinic:8080", "https://Usual.clinic:443", "null")


@table(
    ("origin", "host", "alone", "named"),
    [
        (None, "or1:18945", True, True),  # no browser
        ("https://usual.clinic", "or1", False, True),  # a browser leaves the usual port out
        ("http://usual.clinic", "or1", False, False),
        ("http://localhost:8000", "or1:18945", True, True),
        ("https://127.0.0.1", "or1", True, True),
        ("http://[::1]:8000", "or1", True, True),
        ("http://192.168.7.4:8000", "192.168.7.4:18945", True, True),
        ("http://[FE80::1]", "[fe80::1]:18945", True, True),
        ("http://192.168.7.4:8000", "192.168.7.5:18945", False, False),
        ("http://or1:8000", "or1:18945", False, False),  # DNS rebinding
        ("http://localhost.evil.example", "localhost", False, False),
        ("http://127.0.0.1.evil.example", "127.0.0.1", False, False),
        ("null", "127.0.0.1", False, True),
        ("", "", False, False),
        ("https://viewer.clinic", "or1", False, True),
        ("https://VIEWER.clinic", "or1", False, True),
        ("http://viewer.clinic", "or1", False, False),
        ("https://viewer.clinic:8080", "or1", False, False),
        ("http://viewer.clinic:8080", "or1", False, True),
    ],
)
def test_whose_pages_may_connect(origin: str | None, host: str, alone: bool, named: bool) -> None:
    assert Origins().allow(origin, host) is alone
    assert Origins(NAMED).allow(origin, host) is named
    assert Origins(("*",)).allow(origin, host)
