"""``igtl-gateway bridge``: the gateway, live, until Ctrl-C."""

from __future__ import annotations

import argparse
import gc
import sys
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

from igtl_gateway.app.bridge_options import bridge_options, zenoh_endpoint
from igtl_gateway.app.managed import ManagedBridge
from igtl_gateway.app.setting_values import declared
from igtl_gateway.base.addons import check_present, part_of
from igtl_gateway.base.clock import Clock, SystemClock
from igtl_gateway.base.errors import ConfigError, ViewerError
from igtl_gateway.base.extras import missing
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.systems.malloc import tune_malloc
from igtl_gateway.base.systems.service import ServiceManager
from igtl_gateway.cli import recording_keys
from igtl_gateway.cli.bridge_output import BridgeOutput, JsonOutput, TextOutput
from igtl_gateway.cli.bridge_session import BridgeSession, LiveWindow, Page, PlainRunner, options_of_session
from igtl_gateway.cli.common import stop_event
from igtl_gateway.cli.options import NODE_NAME
from igtl_gateway.cli.service_report import ServiceReport
from igtl_gateway.cli.settings import given, settled
from igtl_gateway.cli.terminal import is_terminal, print_line
from igtl_gateway.cli.type_tables import types
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.notations import DDS, DEFAULT_HOST, address
from igtl_gateway.config.settings import all_settings
from igtl_gateway.edges.ros.env import prepare_environment
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.edges.tcp.sockets import AllowList, check_listening
from igtl_gateway.gateway.log.marks import MarkNote

#: Switch interval of the interpreter.  With Python's default of 5 ms, a pose waits that long for an image.
_SWITCH_S = 0.0005
#: Collections of the middle generation before a full one; Python: 10.
_FULL_EACH = 100

_STATUS_EVERY_S = 0.5
_SHARED_TF = (
    "poses go to /tf, which all namespaces share; if another bridge has the same device names, give both "
    "--ros-args -r /tf:=tf -r /tf_static:=tf_static"
)
#: Who makes the marks of key ``m``.
_WHO = "keyboard"


def run(options: argparse.Namespace) -> int:
    if options.types:
        print_line(*types())
        return 0
    if options.duration is not None and not 0 < options.duration < float("inf"):
        raise ConfigError(f"--duration: found {options.duration:g}, expected a number of seconds above 0")
    if options.ros_args and options.no_ros:
        raise ConfigError("--ros-args: found --no-ros, expected ROS: they are arguments of its node")
    as_text = not options.json and options.log_format != "json"
    clock = SystemClock()
    plan = _Plan(options)
    service = ServiceReport(ServiceManager(), clock)
    problems: deque[str] = deque()  # of transitions
    with stop_event() as stop:
        notes = prepare_environment() if plan.has_host else [tune_malloc()]

        def make(host: NodeHost | None, number: int) -> BridgeSession:
            own = options_of_session(plan.how, number)
            window, page, metrics_at = plan.open_window(), plan.page, plan.metrics_at
            return BridgeSession(
                plan.config(host), own, clock, window=window, page=page, metrics_at=metrics_at, host=host
            )

        out: BridgeOutput = JsonOutput(clock)
        runner: PlainRunner | ManagedBridge[BridgeSession]
        if plan.has_host:
            runner = ManagedBridge(
                make,
                options.node_name or NODE_NAME,
                autostart=not options.no_autostart,
                arguments=options.ros_args,
                on_failure=problems.append,
                on_end=stop.set,
            )
            if as_text:
                out = TextOutput(is_terminal(), runner.host.logs)
        else:
            if as_text:
                out = TextOutput(is_terminal())
            plan.open_page(stop.set, out.page)
            runner = PlainRunner(make(None, 1))
        host = runner.host if isinstance(runner, ManagedBridge) else None
        show = _Show(out, host, notes, clock, plan)
        viewer_problem = ""
        try:
            if isinstance(runner, ManagedBridge):
                runner.host.start(lambda error: problems.append(f"callback: {error}"))
                plan.prepare(runner.host)
                plan.open_page(stop.set, out.page)
            runner.start()
            started_ns = clock.monotonic_ns()
            show.update(runner.bridge)
            _tune_interpreter()
            service.ready()
            while not stop.wait(_STATUS_EVERY_S):
                while problems:
                    out.problem(problems.popleft())
                show.update(runner.bridge)
                service.update(runner.bridge)
                seconds = (clock.monotonic_ns() - started_ns) / NS_PER_S
                if show.must_stop or (options.duration and seconds >= options.duration):
                    break
        finally:
            service.stopping()
            show.release()
            runner.stop()
            viewer_problem = plan.window.close() if plan.window else ""
            if plan.page:
                plan.page.close()
        show.end()
        if viewer_problem:
            print_line(f"igtl-gateway bridge: --view: {viewer_problem}", error=True)
    return 1 if show.has_failed else 0


class _Plan:
    """The configuration of the sessions: of the command line and a file, and of the parameters of the node.

    Attributes:
        ros: whether there is a node.
        has_host: whether rclpy has it: then it is a managed node with parameters.
        how: options of the bridge.
        metrics_at: address of ``--metrics``; None: there is none.
        window: of ``--view``, once a session has needed it.
        page: of ``--page``, after `open_page`.

    Raises:
        ConfigError: for a wrong setting; with ``--ros-args``, only after `prepare` all are known.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        values = settled(options, {})
        self.ros = not (options.no_ros or values["relay"])
        over_zenoh = zenoh_endpoint(values) is not None
        if "ros" in given(options, all_settings()) and not self.ros:  # of a file, it is not used
            raise ConfigError(
                f"--ros {values['ros']}: found --no-ros or --relay, expected neither: they run without ROS"
            )
        self.has_host = self.ros and not over_zenoh
        if options.no_autostart and not self.ros:
            raise ConfigError(
                "--no-autostart: found no ROS, expected it: other nodes configure and activate the bridge"
            )
        if options.node_name and not self.ros:
            raise ConfigError("--node-name: found --no-ros or --relay, expected neither: without ROS there is no node")
        for is_given, option in ((options.no_autostart, "--no-autostart"), (options.ros_args, "--ros-args")):
            if is_given and over_zenoh:
                raise ConfigError(
                    f"{option}: found --ros {values['ros']}, expected --ros {DDS}: it needs a node of rclpy"
                )
        self.window: LiveWindow | None = None
        self.page: Page | None = None
        if not options.ros_args:
            self._take(values)

    def _take(self, values: Mapping[str, Any]) -> None:
        options = self._options
        self._config, self.how = bridge_options(
            values,
            ros=self.ros,
            node_name=options.node_name or NODE_NAME,
            given=given(options, all_settings()),
            reserved=options.reserved,
        )
        self._values = values
        self.metrics_at = address(values["metrics"]) if values["metrics"] else None
        self._page_at = address(values["page_address"]) if values.get("page_address") else (DEFAULT_HOST, 0)
        if values.get("page"):  # its process would report it after the start
            check_listening(*self._page_at, AllowList(self.how.allow))

    def prepare(self, host: NodeHost) -> None:
        """Take the parameters that the node was started with, and declare all."""
        if self._options.ros_args:
            self._take(settled(self._options, host.overrides()))
        host.declare(declared(self._values, self._config))

    def config(self, host: NodeHost | None) -> Config:
        """Return the configuration of the next session, with the parameters that have changed since the start."""
        return replace(self._config, **host.changed_values()) if host else self._config  # type: ignore[arg-type]

    def open_window(self) -> LiveWindow | None:
        """Return the window of ``--view``.  Raises ViewerError without rerun."""
        if self._values.get("view") and self.window is None:
            self.window = _window(self._config)
            print_line(_READABLE, error=True)
        return self.window

    def open_page(self, on_stop: Callable[[], None], on_links: Callable[[str, str], None]) -> None:
        """Open the page of ``--page``, in a thread that lasts as long: the process ends with it."""
        values = self._values
        if values.get("page"):
            tls = (values["tls_cert"], values["tls_key"]) if values["tls_cert"] else None
            made = part_of("page", "live:BridgePage")
            self.page = made(self._page_at, self.how.allow, tls, self.how.record, on_stop, on_links)


#: rerun's window has no access control for streams.
_READABLE = (
    "igtl-gateway bridge: --view: other users of this machine can read what the window shows (docs/how-to/security.md)"
)


class _Show:
    """What the verb shows of its sessions, which run one after the other.

    Attributes:
        has_failed: whether the recording of a session that has ended failed.
    """

    def __init__(self, out: BridgeOutput, host: NodeHost | None, notes: list[str], clock: Clock, plan: _Plan) -> None:
        self.has_failed = False
        self._plan = plan
        self._out = out
        self._host = host
        self._notes = notes
        self._clock = clock
        self._session: BridgeSession | None = None
        self._is_waiting = False
        self._started_ns = 0
        self._controls = ExitStack()

    @property
    def must_stop(self) -> bool:
        """Whether the recording has failed and the options require the bridge to stop."""
        return self._session is not None and self._session.bridge.has_failed

    def update(self, session: BridgeSession | None) -> None:
        """Show the session that runs now; None: there is none."""
        if session is not self._session:
            self.release()
            self.end()
            if session:
                self._begin(session)
        page = self._plan.page
        if session is None:
            if page:
                page.update(None)
            if not self._is_waiting:
                self._is_waiting = True
                self._out.waiting(self._host.full_name if self._host else "")
            return
        bridge, watch = session.bridge, session.watch
        events = watch.take(bridge.hub.now_ns()) + bridge.take_reports()
        session.sample()  # first: who reads of an event here finds it in the state
        self._out.events(events)
        bridge.collect()
        self._out.status(bridge, watch, (self._clock.monotonic_ns() - self._started_ns) / NS_PER_S)
        if page:
            page.update(session, events)

    def _begin(self, session: BridgeSession) -> None:
        self._session, self._is_waiting = session, False
        self._started_ns = self._clock.monotonic_ns()
        bridge = session.bridge
        keys = self._controls.enter_context(
            recording_keys.recording_controls(
                bridge.recorder, lambda line, ago_ns: bridge.mark(MarkNote.parse(line, _WHO, ago_ns))
            )
        )
        shared = _SHARED_TF if bridge.gateway.config.publish_tf and self._host and self._host.shares_tf else ""
        notes = [note for note in (*self._notes, shared, bridge.realtime, keys) if note]
        self._out.started(bridge, bridge.gateway.config, notes, session.metrics)

    def release(self) -> None:
        """Release keys and signals, which control the recording of the session."""
        self._controls.close()

    def end(self) -> None:
        """Show the end of the session, which is closed."""
        session, self._session = self._session, None
        if session:
            self._out.events(session.watch.take())
            self._out.stopped(session.bridge, session.watch)
            self.has_failed |= bool(session.bridge.summary and session.bridge.summary.failure)


def _window(config: Config) -> LiveWindow:
    check_present("view")
    if find_spec("rerun") is None:
        raise ViewerError(missing("rerun"))
    window: LiveWindow = part_of("view", "live:LiveWindow")(config)
    return window


def _tune_interpreter() -> None:
    """Exclude all existing objects from garbage collection, and set the switch interval.  Call this after the start.

    With rclpy and numpy loaded, a full collection takes tens of milliseconds, and so does one of the streams that peers
    invent: it comes rarely.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*gc.get_threshold()[:2], _FULL_EACH)
    sys.setswitchinterval(_SWITCH_S)
