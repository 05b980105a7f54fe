"""The pytest plugin: four fixtures.  pytest loads it at the start of each run, so imports are in the fixtures."""

from __future__ import annotations

import warnings
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

    The arguments are those of ``igtl_gateway.testing.peer.ReplayPeer``.  Relative paths are relative to the folder of
    the test if the file exists there, otherwise to the working directory.
    """
    from igtl_gateway.testing.peer import ReplayPeer

    with ExitStack() as peers:

        def start(recording: Path | str, *, config: Any = None, **settings: Any) -> ReplayPeer:
            settings["config"] = _resolve(request, config)
            return peers.enter_context(ReplayPeer(_resolve(request, recording), **settings))

        yield start


@pytest.fixture(name="igtl_gateway")
def _igtl_gateway(request: pytest.FixtureRequest) -> Callable[..., ManualGateway]:
    """``igtl_gateway(ros_unit="mm")``: the core of the gateway on manual time.

    The argument is a ``Config`` or the path of a configuration file or recording; settings by name override it.
    """
    from igtl_gateway.testing.gateway import ManualGateway

    def make(config: Any = None, **settings: Any) -> ManualGateway:
        return ManualGateway(_resolve(request, config), **settings)

    return make


@pytest.fixture(name="assert_session_equal")
def _assert_session_equal(request: pytest.FixtureRequest) -> Callable[..., None]:
    """``assert_session_equal("golden.mcap", gateway, tolerance_mm=0.01)``: fails with a list of the differences.

    The arguments are those of ``igtl_gateway.testing.compare.assert_session_equal``.
    """
    from igtl_gateway.testing.compare import assert_session_equal

    def check(expected: Session, found: Session, **settings: Any) -> None:
        assert_session_equal(_resolve(request, expected), _resolve(request, found), **settings)

    return check


@pytest.fixture(name="igtl_resim")
def _igtl_resim(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """``igtl_resim("lab.mcap", "python planner.py", baseline="good.mcap")``: fails unless the outputs are as before.

    Runs ROS 2 programs on a recording, several times, in session time; returns the ``Resimulation``.  Its ``outputs``
    are kept as long as ``tmp_path``.  The arguments are those of ``igtl_gateway.resim``; programs run in the folder of
    the test.  A timer that races a topic fails it, unless ``permit_races=True``: then it is a warning, and a property
    of the test in JUnit.  Needs the add-on resim.
    """
    from igtl_gateway.base.addons import part_of

    def check(recording: Path | str, *programs: Any, baseline: Path | str | None = None, **settings: Any) -> Any:
        __tracebackhide__ = True
        resim = part_of("resim", "api:resim")
        path, before = _resolve(request, recording), _resolve(request, baseline)
        if before is not None and not Path(before).exists():
            raise AssertionError(
                f"found no baseline {before}, expected the outputs of a good run: "
                f"igtl-gateway resim {recording} --record {baseline} -- PROGRAM"
            )
        settings = {"cwd": request.path.parent, "folder": tmp_path_factory.mktemp("resim"), **settings}
        found = resim(path, *programs, baseline=before, **settings)
        if not found.is_equal:
            raise AssertionError(str(found))
        if not found.inputs:
            raise AssertionError(f"the programs received nothing of {recording}, expected an input\n{found}")
        if found.race:
            request.node.user_properties.append(("igtl_resim_race", found.race))
            if not found.verdict.race.is_sample:
                warnings.warn(found.race, stacklevel=2)
        return found

    return check


def _resolve(request: pytest.FixtureRequest, given: Any) -> Any:
    """Return the path of a file in the folder of the test; other paths and other arguments unchanged."""
    if isinstance(given, str | Path) and (beside := request.path.parent / given).exists():
        return beside
    return given
