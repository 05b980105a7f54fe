"""Certificates, access control and routers that are away: notes, counts that add up, and nothing that hangs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from igtl_gateway.base.clock import SystemClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.convert.rosmsg import String
from tests.addons.zenoh.routers import router
from tests.addons.zenoh.test_edge import Side, counts, port, sides, started, text, until

__all__ = ["port", "sides"]

from tests.places import PEMS

TLS = "transport__link__tls__"


def pem(name: str) -> str:
    return str(PEMS / f"{name}.pem")


@contextmanager
def secure_router(port: int, certificate: str = "server", **values: Any) -> Iterator[Any]:
    """A router that requires a certificate of the test CA."""
    files = {"root_ca_certificate": "ca", "listen_private_key": certificate, "listen_certificate": certificate}
    tls = {f"{TLS}{name}": pem(file) for name, file in files.items()} | {f"{TLS}enable_mtls": True}
    with router(port, **({"listen__endpoints": [f"tls/127.0.0.1:{port}"]} | tls | values)) as session:
        yield session


def as_client(monkeypatch: pytest.MonkeyPatch, certificate: str) -> None:
    """The environment of a client with this certificate; "": without one."""
    rules = [f'transport/link/tls/root_ca_certificate="{pem("ca")}"', "transport/link/tls/enable_mtls=true"]
    if certificate:
        rules += [f'transport/link/tls/connect_{what}="{pem(certificate)}"' for what in ("private_key", "certificate")]
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", ";".join(rules))


@pytest.mark.parametrize(
    ("certificate", "of_router"),
    [("viewer", "server"), ("stranger", "server"), ("", "server"), ("viewer", "elsewhere")],
)
def test_certificates(certificate: str, of_router: str, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    as_client(monkeypatch, certificate)
    with secure_router(port, of_router):
        side = Side(port, scheme="tls")
        side.edge.start()
        side.edge.publish("/out", String.TYPE, text("x"), Qos(5))
        side.edge.publish("/out", String.TYPE, text("y"), Qos(5))
        begun_ns = SystemClock().monotonic_ns()
        side.edge.stop()
        assert SystemClock().monotonic_ns() - begun_ns < 5 * NS_PER_S
    found = side.edge.counters()["/out"]
    if (certificate, of_router) == ("viewer", "server"):
        assert side.codes() == ["zenoh_connected"]
    else:
        assert side.codes() == ["zenoh_no_router"]
        assert "certificate" in side.notes[0].text
        assert found == counts(unheard=2)
    assert found["published"] + found["unheard"] == 2


#: What a hospital's router would have: the robot's side publishes below /out, the viewer only listens to it.
ACL = {
    "enabled": True,
    "default_permission": "deny",
    "rules": [
        {
            "id": "publish",
            "permission": "allow",
            "flows": ["ingress"],
            "messages": ["put", "reply", "liveliness_token", "declare_queryable"],
            "key_exprs": ["7/out/**", "7/out/**/@adv/**", "@ros2_lv/7/**"],
        },
        {
            "id": "watch",
            "permission": "allow",
            "flows": ["ingress"],
            "messages": ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"],
            "key_exprs": ["7/**", "7/**/@adv/**", "@ros2_lv/7/**"],
        },
        {
            "id": "receive",
            "permission": "allow",
            "flows": ["egress"],
            "messages": [
                *("put", "reply", "query", "declare_subscriber", "declare_queryable", "liveliness_token"),
                *("liveliness_query", "declare_liveliness_subscriber"),
            ],
            "key_exprs": ["7/**", "7/**/@adv/**", "@ros2_lv/7/**"],
        },
    ],
    "subjects": [
        {"id": "robot", "cert_common_names": ["TEST ONLY server"]},
        {"id": "viewer", "cert_common_names": ["TEST ONLY viewer"]},
    ],
    "policies": [
        {"rules": ["publish", "watch", "receive"], "subjects": ["robot"]},
        {"rules": ["watch", "receive"], "subjects": ["viewer"]},
    ],
}


def test_access_control(port: int, sides: ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    with secure_router(port, access_control=ACL):
        as_client(monkeypatch, "server")
        robot = started(sides, port, ("/in",), name="robot", scheme="tls")
        robot.edge.advertise("/out/pose", String.TYPE, Qos(5))
        robot.edge.publish("/out/plan", String.TYPE, text("latched"), Qos(1, latched=True))
        robot.edge.publish("/secret", String.TYPE, text("denied"), Qos(1, latched=True))
        as_client(monkeypatch, "viewer")
        viewer = started(sides, port, ("/out/pose", "/out/plan", "/secret"), name="viewer", scheme="tls")
        viewer.wait(lambda: len(viewer.messages) == 1)
        robot.wait(lambda: "/out/pose" in robot.heard)
        robot.edge.publish("/out/pose", String.TYPE, text("live"), Qos(5))
        viewer.wait(lambda: len(viewer.messages) == 2)
        assert [message[2] for message in viewer.messages] == [text("latched"), text("live")]
        # the viewer's publisher is denied: the robot never sees it, and its messages have no subscriber
        viewer.edge.publish("/in", String.TYPE, text("command"), Qos(5))
        until(lambda: not viewer.edge.has_subscriber("/in"))
        assert viewer.edge.count_if_unsubscribed("/in")
        assert robot.edge.subscriptions() == []
    for side in (robot, viewer):
        side.wait_code("zenoh_lost")
        side.edge.stop()
    assert viewer.edge.counters()["/in"] == counts(published=1, unheard=1)
    assert robot.messages == []
