"""A bridge as a managed node of ROS 2, with the states and transitions of ``lifecycle_msgs``.

*configure* opens a bridge that refuses all messages, *activate* and *deactivate* let them pass and refuse them,
*cleanup* closes the bridge.  Each bridge is one session, with a recording of its own.  The node outlives its bridges.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, Protocol, TypeVar

from igtl_gateway.base.errors import GatewayError, RosError
from igtl_gateway.edges.ros.host import NodeHost


class OpenBridge(Protocol):
    """What is managed: a ``Bridge``, or what has one."""

    def start(self, *, active: bool) -> None: ...
    def change(self, changes: Mapping[str, object]) -> None: ...
    def stop(self) -> None: ...


B = TypeVar("B", bound=OpenBridge)


class ManagedBridge(Generic[B]):
    """The node, and the bridge that it has in the states *inactive* and *active*.

    Args:
        make: returns a new bridge on the node of a host for the session with this number, from 1.
        node_name: name of the node.
        arguments: of ROS, see ``NodeHost``.
        autostart: configure and activate at the start; else the node waits for the transitions.
        on_failure: called with one line about a transition that failed.
        on_end: called after the transition *shutdown*.

    Attributes:
        bridge: the bridge; None in the states *unconfigured* and *finalized*.
        host: the node; `start` starts it, unless its owner has done so before, for example to read its parameters.
            Transitions wait until `start`.
    """

    def __init__(
        self,
        make: Callable[[NodeHost, int], B],
        node_name: str,
        *,
        autostart: bool,
        arguments: Sequence[str] = (),
        on_failure: Callable[[str], None],
        on_end: Callable[[], None],
    ) -> None:
        self.bridge: B | None = None
        self.host = NodeHost(node_name, transitions=self, arguments=arguments, starts_active=autostart)
        self._make = make
        self._autostart = autostart
        self._on_failure = on_failure
        self._on_end = on_end
        self._lock = threading.RLock()
        self._is_starting = autostart  # by itself: the first two transitions have nothing to do
        self._is_ready = threading.Event()  # for transitions
        self._sessions = 0
        self._is_stopping = False

    def start(self) -> None:
        """Join the graph, and start the bridge if it is to start by itself.

        Raises what ``Bridge.start`` raises; then everything is closed.
        """
        with self._lock:
            try:
                if self._autostart:
                    self._open(active=True)
                elif not self.host.is_running:
                    self.host.start(lambda error: self._on_failure(f"{type(error).__name__}: {error}"))
            except BaseException:
                self.stop()
                raise
            finally:
                self._is_starting = False
                self._is_ready.set()

    def stop(self) -> None:
        """Close the bridge and leave the graph.  A second call has no effect."""
        self._is_stopping = True
        self._is_ready.set()
        self._close()
        self.host.stop()

    # -- transitions, in a thread of the node's executor ----------------------------------------------------------

    def configure(self) -> bool:
        """Check the settings and open the bridge; messages do not pass yet."""
        return self._is_starting or self._does("configure", lambda: self._open(active=False))

    def activate(self) -> bool:
        """Let messages pass."""
        return self._is_starting or self._does("activate", lambda: self._change(active=True))

    def deactivate(self) -> bool:
        """Refuse all messages."""
        return self._does("deactivate", lambda: self._change(active=False))

    def cleanup(self) -> bool:
        """Close the bridge and its recording."""
        return self._does("cleanup", self._close)

    def shutdown(self) -> bool:
        """Close the bridge; the node is to leave the graph."""
        try:
            return self._does("shutdown", self._close)
        finally:
            self._on_end()

    def error(self) -> bool:
        """Close what a transition with an unexpected error has left."""
        return self._does("error processing", self._close)

    def _does(self, name: str, action: Callable[[], None]) -> bool:
        """Return whether an action succeeds; report why not.  Raises what is not an error of the gateway."""
        self._is_ready.wait()
        with self._lock:
            try:
                action()
            except GatewayError as error:
                self._on_failure(f"{name}: {error}")
                return False
            except Exception as error:
                self._on_failure(f"{name}: {type(error).__name__}: {error}")
                raise
            return True

    def _open(self, *, active: bool) -> None:
        if self._is_stopping:
            raise RosError("the node is about to leave the graph")
        bridge = self._make(self.host, self._sessions + 1)
        bridge.start(active=active)
        self.bridge = bridge
        self._sessions += 1

    def _change(self, *, active: bool) -> None:
        if self.bridge is None:
            raise RosError("the bridge is closed")
        self.bridge.change({"active": active})

    def _close(self) -> None:
        with self._lock:
            if self.bridge:
                self.bridge.stop()
            self.bridge = None
