"""Keyword arguments of the Python API: settings checked by their table, and errors that name arguments, not options."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike, fspath
from typing import Any

from igtl_gateway.app.rows import rows_of
from igtl_gateway.base.errors import ConfigError, RecordingError, Unavailable
from igtl_gateway.config.settings import BY_SETTING, ROWS, SETTINGS, Setting, unknown

BEGIN = "--ros-args"

#: Settings of the command line alone: it serves them from its own thread.
_OF_THE_COMMAND_LINE = frozenset({"metrics"})
_OF_A_BRIDGE = {row.flag: row.name for row in SETTINGS if row.flag} | {BEGIN: "ros_args", "--no-ros": "ros=False"}
_OF_A_REPLAY = (
    {f"--{name}": name for name in ("to", "rate", "start", "end", "duration", "streams", "send", "restamp", "loop")}
    | {"--through-gateway": "through_gateway", "--wait-peers": "wait_peers", "--fault": "fault", "--seed": "seed"}
    | {"--delay": "delay_s", "--clock": "clock_hz", "--allow": "allow", "--config": "config", BEGIN: "ros_args"}
    | {"--tls-cert": "tls.cert", "--tls-key": "tls.key", "--tls-ca": "tls.ca"}
)
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")
_CHOICE = re.compile(r"(?<![\w-])--(to|restamp) (igtl|ros|both|keep|now|shift)\b")


@contextmanager
def of_a_bridge() -> Iterator[None]:
    """Errors of the settings of a bridge name them as ``Bridge`` does."""
    with _spelled(_OF_A_BRIDGE):
        yield


@contextmanager
def of_a_replay() -> Iterator[None]:
    """Errors of the options of a replay name them as ``replay`` does."""
    with _spelled(_OF_A_REPLAY):
        yield


@contextmanager
def _spelled(names: Mapping[str, str]) -> Iterator[None]:
    try:
        yield
    except (ConfigError, RecordingError, Unavailable) as error:
        text = _CHOICE.sub(r"\1='\2'", str(error))
        error.args = (_OPTION.sub(lambda found: names.get(found[0], found[0]), text),)
        raise


def addresses(name: str, given: object) -> tuple[tuple[str, int], ...]:
    """Return addresses as pairs of host and port.  Raises ConfigError."""
    expected = "a list of pairs such as ('127.0.0.1', 18944)"
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ConfigError(f"{name}: found {given!r}, expected {expected}")
    found = tuple(tuple(each) if isinstance(each, list | tuple) else each for each in given)
    for each in found:
        match each:
            case (str(), int(port)) if 0 <= port <= 65535:
                continue
        raise ConfigError(f"{name}: found {each!r}, expected {expected}")
    return found


def texts(name: str, given: object) -> tuple[str, ...]:
    """Return strings as a tuple; one string is one of them, not its letters.  Raises ConfigError."""
    if isinstance(given, str):
        return (given,)
    found = tuple(given) if isinstance(given, Iterable) else (given,)
    if not all(isinstance(each, str) for each in found):
        raise ConfigError(f"{name}: found {given!r}, expected a string or a list of strings")
    return found


def one_of(name: str, found: object, choices: Sequence[str]) -> None:
    """Raises ConfigError if a value is not one of the choices."""
    if found not in choices:
        raise ConfigError(f"{name}: found {found!r}, expected one of {', '.join(map(repr, choices))}")


def numbers(*, optional: bool = False, **given: object) -> None:
    """Raises ConfigError for an argument that is not a number; ``optional``: it may be None."""
    for name, found in given.items():
        is_number = isinstance(found, int | float) and not isinstance(found, bool)
        if not (is_number or (optional and found is None)):
            raise ConfigError(f"{name}: found {found!r}, expected a number{' or None' if optional else ''}")


def ros_arguments(given: Sequence[str], *, ros: bool, without: str) -> tuple[str, ...]:
    """Return arguments of ROS as a node has them, from ``--ros-args`` on; () without any.

    Args:
        given: the arguments, with or without ``--ros-args`` in front.
        ros: whether there is a node.
        without: the argument that leaves it out, as text.

    Raises:
        ConfigError: not a list of strings, or there is no node.
    """
    if isinstance(given, str) or not all(isinstance(word, str) for word in given):
        raise ConfigError(f"ros_args: found {given!r}, expected a list of strings such as ['-r', '__ns:=/or1']")
    if given and not ros:
        raise ConfigError(f"ros_args: found {without}, expected ROS: they are arguments of its node")
    return (*(() if given[0] == BEGIN else (BEGIN,)), *given) if given else ()


def checked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as the types of the table.  Raises ConfigError with the name of the setting."""
    values: dict[str, Any] = {}
    for name, value in settings.items():
        row = BY_SETTING.get(name)
        if row is None or name in _OF_THE_COMMAND_LINE:
            raise ConfigError(f"{name}: {unknown(name, BY_SETTING.keys() - _OF_THE_COMMAND_LINE)}")
        try:
            values[name] = _rows(row, value) if row.table == ROWS else row.check(_plain(row, value))
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    return values


def _plain(row: Setting, value: Any) -> Any:
    """A path as a string."""
    return fspath(value) if isinstance(row.default, str) and isinstance(value, PathLike) else value


def _rows(row: Setting, value: Any) -> tuple[dict[str, Any], ...]:
    """Rows of messages: strings as of the option, or dicts."""
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    if not is_list or not all(isinstance(item, str | Mapping) for item in value):
        raise ConfigError(f"found {value!r}, expected a list of strings or of dicts")
    texts = [item for item in value if isinstance(item, str)]
    return (*rows_of(row, texts), *(dict(item) for item in value if not isinstance(item, str)))
