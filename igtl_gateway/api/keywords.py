"""Keyword arguments of the Python API: settings checked by their table, and errors that name arguments, not options."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike, fspath
from typing import Any, TypeVar

from igtl_gateway.app.replay_settings import REPLAY
from igtl_gateway.app.rows import rows_of
from igtl_gateway.base.addons import check_setting
from igtl_gateway.base.errors import ConfigError, RecordingError, Unavailable
from igtl_gateway.config.setting import ROWS, Setting, unknown
from igtl_gateway.config.settings import all_settings
from igtl_gateway.edges.tcp import TlsFiles

F = TypeVar("F", bound=Callable[..., object])

BEGIN = "--ros-args"
#: Keywords that are a number of seconds, or a date and time.
_MOMENTS = ("start", "end")

_OF_A_REPLAY = {row.flag: row.name for row in REPLAY} | {
    BEGIN: "ros_args",
    "--tls-cert": "tls.cert",
    "--tls-key": "tls.key",
    "--tls-ca": "tls.ca",
}
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")
_CHOICE = re.compile(r"(?<![\w-])--(to|restamp) (igtl|ros|both|keep|now|shift)\b")


@contextmanager
def of_a_bridge() -> Iterator[None]:
    """Errors of the settings of a bridge name them as ``Bridge`` does."""
    with _spelled(
        {row.flag: row.name for row in all_settings() if row.flag} | {BEGIN: "ros_args", "--no-ros": "ros=False"}
    ):
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


def keywords(rows: Iterable[Setting]) -> dict[str, Setting]:
    """Return the settings that the Python API has, by name."""
    return {row.name: row for row in rows if row.keyword}


def checked(settings: Mapping[str, Any], rows: Iterable[Setting]) -> dict[str, Any]:
    """Return settings as the types of a table.  Raises ConfigError with the name of the setting."""
    known = keywords(rows)
    values: dict[str, Any] = {}
    for name, value in settings.items():
        row = known.get(name)
        if row is None:
            check_setting(name)
            raise ConfigError(f"{name}: {unknown(name, known)}")
        try:
            values[name] = _rows(row, value) if row.table == ROWS else row.check(_plain(row, value))
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    return values


def replay_values(to: str, tls: TlsFiles | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of all options of a replay for its arguments.  Raises ConfigError."""
    given: dict[str, Any] = {"to": to, **settings}
    places = {name: addresses(name, given.pop(name)) for name in ("listen", "connect") if name in given}
    known = keywords(REPLAY)
    for name, value in given.items():
        if name in known and known[name].is_list:
            given[name] = texts(name, value)
        elif name in _MOMENTS and isinstance(value, int | float) and not isinstance(value, bool):
            given[name] = str(value)
    found = {row.name: row.default for row in REPLAY} | checked(given, REPLAY) | places
    if tls is not None:
        names = ("tls_cert", "tls_key", "tls_ca")
        found |= dict(zip(names, (fspath(each) if each else "" for each in (tls.cert, tls.key, tls.ca)), strict=True))
        found["tls"] = True
    return found


def with_keywords(rows: Sequence[Setting]) -> Callable[[F], F]:
    """Return a decorator: the signature of a function names these rows in place of ``**settings``.

    ``help`` and the completion of notebooks show them.
    """

    def decorate(function: F) -> F:
        signature = inspect.signature(function)
        own = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
        made = [
            inspect.Parameter(row.name, inspect.Parameter.KEYWORD_ONLY, default=row.default)
            for row in keywords(rows).values()
            if row.name not in signature.parameters
        ]
        function.__signature__ = signature.replace(parameters=[*own, *made])  # type: ignore[attr-defined]
        return function

    return decorate


def _plain(row: Setting, value: Any) -> Any:
    """A path as a string."""
    return fspath(value) if row.type is str and isinstance(value, PathLike) else value


def _rows(row: Setting, value: Any) -> tuple[dict[str, Any], ...]:
    """Rows of messages: strings as of the option, or dicts."""
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    if not is_list or not all(isinstance(item, str | Mapping) for item in value):
        raise ConfigError(f"found {value!r}, expected a list of strings or of dicts")
    texts = [item for item in value if isinstance(item, str)]
    return (*rows_of(row, texts), *(dict(item) for item in value if not isinstance(item, str)))
