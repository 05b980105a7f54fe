"""rclpy itself, imported when a node starts, and what is made of its types: message classes and profiles of QoS."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from operator import attrgetter
from typing import Any

from igtl_gateway.base.errors import RosError, UnknownTypeError, first_line
from igtl_gateway.base.extras import missing
from igtl_gateway.base.qos import Qos
from igtl_gateway.edges.ros.distributions import EVENT_MODULES

_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv)/([A-Z][A-Za-z0-9]*)")
_DERIVED = re.compile(r"([a-z][a-z0-9_]*)/(srv|action)/([A-Z][A-Za-z0-9]*)_(\w+)")
#: Where rosidl puts the messages that it derives from a service or an action, below its class.
_BELOW = {
    ("srv", "Event"): "Event",
    ("action", "FeedbackMessage"): "Impl.FeedbackMessage",
    ("action", "SendGoal"): "Impl.SendGoalService",
    ("action", "GetResult"): "Impl.GetResultService",
    ("action", "SendGoal_Event"): "Impl.SendGoalService.Event",
    ("action", "GetResult_Event"): "Impl.GetResultService.Event",
}
_RMW_CHECK_S = 60
_SUBMODULES = (
    "callback_groups",
    "context",
    "duration",
    "executors",
    "guard_condition",
    "node",
    "qos",
    "serialization",
    "subscription",
    "impl.implementation_singleton",
)


def import_rclpy() -> Any:
    """Return rclpy with the submodules that we use.  Raises RosError if it is missing, or its middleware is."""
    wanted = os.environ.get("RMW_IMPLEMENTATION")
    if wanted and "rclpy" not in sys.modules:
        _check_rmw(wanted)
    try:
        rclpy = importlib.import_module("rclpy")
        for name in _SUBMODULES:
            importlib.import_module(f"rclpy.{name}")
        events = (name for name in EVENT_MODULES if importlib.util.find_spec(f"rclpy.{name}"))
        importlib.import_module(f"rclpy.{next(events, EVENT_MODULES[0])}")
    except ImportError as error:
        raise RosError(missing("rclpy", error)) from error
    return rclpy


def import_lifecycle() -> Any:
    """Return rclpy's module for managed nodes.  Raises RosError if it is missing."""
    try:
        return importlib.import_module("rclpy.lifecycle")
    except ImportError as error:
        raise RosError(missing("rclpy", error)) from error


def _check_rmw(wanted: str) -> None:
    """Try the import in another process: with a middleware that is not installed it ends the whole process."""
    tried = subprocess.run(
        [sys.executable, "-c", "import rclpy.impl.implementation_singleton"],
        capture_output=True,
        text=True,
        errors="replace",
        timeout=_RMW_CHECK_S,
        check=False,
    )
    if tried.returncode and "ImportError" not in tried.stderr and "ModuleNotFoundError" not in tried.stderr:
        lines = tried.stderr.strip().splitlines() or [f"exit code {tried.returncode}"]
        raise RosError(f"RMW_IMPLEMENTATION={wanted} does not work here ({lines[-1]}); unset it or install it")


def interface_class(type_name: str) -> Any:
    """Return the Python class of ``"pkg/msg/Name"`` or ``"pkg/srv/Name"``, of an event or a feedback.

    Raises UnknownTypeError if it is not installed here.
    """
    match, below = _TYPE.fullmatch(type_name), ""
    if not match and (match := _DERIVED.fullmatch(type_name)):
        below = _BELOW.get((match[2], match[4]), "")
    if not match or (match.re is _DERIVED and not below):
        raise UnknownTypeError(f'unknown type, found {type_name!r}, expected "package/msg/Name"')
    package, kind, name = match.groups()[:3]
    try:
        return attrgetter(f"{name}.{below}".rstrip("."))(importlib.import_module(f"{package}.{kind}"))
    except (ImportError, AttributeError) as error:
        # only where there is none: what could not be compiled has its own reason
        advice = "" if type(error) is ImportError else f" (install the package {package} for it)"
        raise UnknownTypeError(f"unknown type, {first_line(error)}{advice}") from error


def profile_of(rclpy: Any, qos: Qos, lifespan_ns: int | None = None) -> Any:
    """Return the rclpy profile of ``qos``; ``lifespan_ns``: of each message, 0 and None: no limit."""
    policies = rclpy.qos
    limited = {"lifespan": rclpy.duration.Duration(nanoseconds=lifespan_ns)} if lifespan_ns else {}
    return policies.QoSProfile(
        **limited,
        history=policies.HistoryPolicy.KEEP_LAST,
        depth=qos.depth,
        reliability=policies.ReliabilityPolicy.RELIABLE if qos.reliable else policies.ReliabilityPolicy.BEST_EFFORT,
        durability=policies.DurabilityPolicy.TRANSIENT_LOCAL if qos.latched else policies.DurabilityPolicy.VOLATILE,
    )


def qos_of(rclpy: Any, profile: Any) -> Qos:
    """Return depth, reliability and durability of an rclpy profile."""
    policies = rclpy.qos
    return Qos(
        profile.depth,
        profile.reliability == policies.ReliabilityPolicy.RELIABLE,
        profile.durability == policies.DurabilityPolicy.TRANSIENT_LOCAL,
    )
