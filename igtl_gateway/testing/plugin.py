"""The pytest plugin: three fixtures.  Loaded at the start of every pytest run, so it imports nothing by itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from igtl_gateway.testing.compare import Session
    from igtl_gateway.testing.gateway import ManualGateway
    from igtl_gateway.testing.peer import ReplayPeer


@pytest.fixture(name="igtl_replay")
def _igtl_replay(request: pytest.FixtureRequest) -> Iterator[Callable[..., ReplayPeer]]:
    """``igtl_replay("star.mcap", streams=("TRANSFORM/*",))``: a peer that plays a recording; closed after the test.

    The arguments are those of ``igtl_gateway.testing.peer.ReplayPeer``.  A relative path is looked for beside the
    file of the test first.
    """
    from igtl_gateway.testing.peer import ReplayPeer

    with ExitStack() as peers:

        def start(recording: Path | str, *, config: Any = None, **settings: Any) -> ReplayPeer:
            settings["config"] = _found(request, config)
            return peers.enter_context(ReplayPeer(_found(request, recording), **settings))

        yield start


@pytest.fixture(name="igtl_gateway")
def _igtl_gateway(request: pytest.FixtureRequest) -> Callable[..., ManualGateway]:
    """``igtl_gateway(ros_unit="mm")``: the gateway's core on manual time, as configured.

    Either settings by name, or the path of a configuration file, or a ``Config``.
    """
    from igtl_gateway.testing.gateway import ManualGateway

    def make(config: Any = None, **settings: Any) -> ManualGateway:
        return ManualGateway(_found(request, config), **settings)

    return make


@pytest.fixture(name="assert_session_equal")
def _assert_session_equal(request: pytest.FixtureRequest) -> Callable[..., None]:
    """``assert_session_equal("golden.mcap", gateway, tolerance_mm=0.01)``: fails and says where two sessions differ.

    The arguments are those of ``igtl_gateway.testing.compare.assert_session_equal``.
    """
    from igtl_gateway.testing.compare import assert_session_equal

    def check(expected: Session, found: Session, **settings: Any) -> None:
        assert_session_equal(_found(request, expected), _found(request, found), **settings)

    return check


def _found(request: pytest.FixtureRequest, given: Any) -> Any:
    """A path that names a file beside the test as that file; all else as it is."""
    if isinstance(given, str | Path) and (beside := request.path.parent / given).exists():
        return beside
    return given
