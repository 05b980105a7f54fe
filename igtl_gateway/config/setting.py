"""One setting: what a user can choose, as a row of a table.

An option of a verb, a key of the configuration file, a parameter of the ROS node and a keyword argument of the Python
API are made of one row: name, type, default, unit, range, description, group in the help and what it needs.  All of
them check a value with ``Setting.check``, so the same mistake has the same message everywhere.

``config.settings`` has the table of ``bridge``, ``app.replay_settings`` that of ``replay``; other verbs and add-ons
have theirs beside their code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of

#: Tables of a configuration file: what influences messages, which is recorded; the OpenIGTLink side; the host; closed
#: recordings.
GATEWAY, IGTL, HOST, RECORD = "gateway", "igtl", "host", "record"
#: No table: such a setting is an option and a parameter.
NONE = ""
#: The setting is a table of a file itself: one row of messages for each ``[[to_igtl]]``.
ROWS = "rows"

#: What a setting may need beside other settings: a graph of ROS, a port for clients, arms with CRTK topics, a port for
#: browsers.
ROS_GRAPH, CLIENTS, ARMS, BROWSERS = "ROS", "clients", "arms", "browsers"

Value = bool | int | float | str | tuple[str, ...] | None

TYPE_NAMES: dict[type, str] = {
    str: "a string in quotes",
    bool: "true or false",
    int: "an integer",
    float: "a number",
    tuple: 'strings such as ["a", "b"]',
}


@dataclass(frozen=True, slots=True)
class Setting:
    """One row of the table.

    Attributes:
        name: key in the file, name of the parameter, and keyword argument of the Python API.
        default: value without a setting; its type is that of the setting, a tuple is a list of strings.
        about: what it does, as the help of its option; options in it become parameters in the descriptor.
        table: table of the file: ``GATEWAY``, ``IGTL``, ``HOST``, ``RECORD``, ``NONE`` or ``ROWS``.
        option: its option; None: by the name; "": it has none.
        metavar: placeholder of its value on the command line.
        unit: of the value.
        least, most: the range of a number, both included; without ``most`` it has no end.
        open_ends: the ends of the range are not part of it.
        choices: the values that it may have; with ``reads``, the usual ones.
        reads: returns the meaning of a string, or of each string of a list.  Raises ConfigError.
        shown: the default, as the help of the option has it; None: the value, where it is more than nothing.
        changes: whether it may change while the bridge runs.
        parameter: whether the node has it: the settings of a relay have no node.
        adds: the command line adds to the list of the file or of the parameters; other settings are replaced.
        common: whether most sessions need it: the short help shows its option.
        needs: settings, or other needs of its verb such as ``ROS_GRAPH``, without which it has no effect.
        group: title of its group in the help; "": the first one.
        kind: type of a value that may also be None; None: that of the default, which may not.
        bare: value of the option if none follows it; None: one must follow.
        instead: options with the same word here exclude each other.
        words: the option of a list takes several words, as well as being repeatable.
        required: the command line needs it.
        keyword: whether the Python API has it.
        short: a letter for the option, such as ``-o``.
        old: earlier names of the option, which work for one release and print the new one.
    """

    name: str
    default: Value
    about: str
    table: str = NONE
    option: str | None = None
    metavar: str | None = None
    unit: str = ""
    least: float | None = None
    most: float | None = None
    open_ends: bool = False
    choices: tuple[str | int, ...] = ()
    reads: Callable[[str], object] | None = None
    shown: str | None = None
    changes: bool = False
    parameter: bool = True
    adds: bool = False
    common: bool = False
    needs: tuple[str, ...] = ()
    group: str = ""
    kind: type | None = None
    bare: Value = None
    instead: str = ""
    words: bool = False
    required: bool = False
    keyword: bool = True
    short: str = ""
    old: tuple[str, ...] = ()

    @property
    def flag(self) -> str:
        """The option; "" if it has none."""
        return f"--{self.name.replace('_', '-')}" if self.option is None else self.option

    @property
    def type(self) -> type:
        """The type of its values, of which a tuple is a list of strings."""
        return self.kind or type(self.default)

    @property
    def is_list(self) -> bool:
        return isinstance(self.default, tuple)

    @property
    def usual(self) -> tuple[str | int, ...]:
        """The choices as they are shown."""
        return tuple(each for each in self.choices if each != "")

    @property
    def usage(self) -> str:
        """The option with the placeholder of its value."""
        return f"{self.flag} {self.metavar}" if self.metavar else self.flag

    @property
    def range_text(self) -> str:
        """The range of a number, for people; "" if it has none."""
        if self.least is None:
            return ""
        if self.most is None:
            return f"more than {self.least:.15g}" if self.open_ends else f"{self.least:.15g} or more"
        least, most = f"{self.least:.15g}", f"{self.most:.15g}"
        return f"more than {least} and less than {most}" if self.open_ends else f"{least} to {most}"

    def check(self, value: object) -> Value:
        """Return a value as its type.  Raises ConfigError with what was found and what is expected, without a place."""
        if value is None and self.kind:
            return None
        kind, found = self.type, value
        if kind is tuple:
            is_list = isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)
            value = tuple(value) if is_list else None  # type: ignore[arg-type]  # it is one
        elif kind is float and type(value) is int and abs(value) < 1 << 63:
            value = float(value)
        if type(value) is not kind:
            raise ConfigError(f"found {found!r}, expected {TYPE_NAMES[kind]}")
        if isinstance(value, int | float) and not self._is_in_range(value):
            raise ConfigError(f"found {value:.15g}, expected {self.range_text}")
        if self.choices and not self.reads and value not in self.choices:
            raise ConfigError(f"found {value!r}, expected {one_of(str(value), map(str, self.usual))}")
        if self.reads and value:
            for text in value if isinstance(value, tuple) else (value,):
                self.reads(str(text))
        return value  # type: ignore[return-value]  # of the type of the default

    def parse(self, text: str) -> Value:
        """Return the value of a word of the command line; of a list, one item.  Raises ConfigError."""
        if self.is_list:
            self.check((text,))
            return text
        value: object = text
        if self.type in (int, float):
            value = _number(text)
        return self.check(value)

    def _is_in_range(self, value: float) -> bool:
        if self.least is None:
            return True
        if self.most is None:
            return (self.least < value if self.open_ends else self.least <= value) and value < float("inf")
        return self.least < value < self.most if self.open_ends else self.least <= value <= self.most


def _number(text: str) -> int | float | str:
    """The number of a string, which a file would have without quotes; otherwise the text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def unknown(name: str, names: Iterable[str]) -> str:
    """The message about a name that no setting has."""
    return f"unknown setting, expected {one_of(name, names)}"


def grouped(group: str, *rows: Setting) -> tuple[Setting, ...]:
    """Return rows in a group of the help."""
    return tuple(replace(row, group=group) for row in rows)


def by_name(rows: Iterable[Setting]) -> dict[str, Setting]:
    """Return a table as name → row."""
    return {row.name: row for row in rows}


def changed(rows: Mapping[str, Setting], values: Mapping[str, object]) -> list[str]:
    """Return the names of the settings whose value is not the default."""
    return [name for name, row in rows.items() if values[name] != row.default]


def check_effect(
    rows: Mapping[str, Setting],
    values: Mapping[str, object],
    names: Iterable[str],
    met: Mapping[str, bool],
    absent: Mapping[str, str],
) -> None:
    """Raise ConfigError for settings that have no effect, because what they need is not there.

    Args:
        rows: name → row of all settings.
        values: the values of all settings.
        names: settings that were given: each is expected to have an effect.
        met: need beside settings → whether it is there.
        absent: such a need → what to report if it is not there.
    """
    without: dict[str, list[str]] = {}  # need → options
    for name in dict.fromkeys(names):
        row = rows.get(name)
        for need in row.needs if row else ():
            if not met.get(need, values.get(need)):
                without.setdefault(need, []).append(row.flag if row and row.flag else name)
    for need, flags in without.items():
        reason = absent.get(need) or f"found no {rows[need].usage}, expected it"
        raise ConfigError(f"{' and '.join(flags)}: {reason}: the option has no effect here")
