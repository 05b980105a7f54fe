"""Routers and plain sessions of Zenoh for tests: what stands at the other end of the edge, without our code."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh


def free_port() -> int:
    """Return a port of this host that nothing listens on."""
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def configured(**values: Any) -> zenoh.Config:
    """Return a configuration; ``__`` in a name stands for a slash."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    for name, value in values.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return config


@contextmanager
def router(port: int, **values: Any) -> Iterator[Any]:
    """A router on a port of loopback, which is closed at the end."""
    endpoint = {"listen__endpoints": [f"tcp/127.0.0.1:{port}"]}
    session: Any = zenoh.open(configured(**({"mode": "router"} | endpoint | values)))
    try:
        yield session
    finally:
        session.close()


@contextmanager
def client(port: int, **values: Any) -> Iterator[Any]:
    """A session of a plain client."""
    endpoint = {"connect__endpoints": [f"tcp/127.0.0.1:{port}"], "connect__timeout_ms": 5000}
    session: Any = zenoh.open(configured(**({"mode": "client", "timestamping__enabled": True} | endpoint | values)))
    try:
        yield session
    finally:
        session.close()
