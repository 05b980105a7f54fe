"""The values of all settings of a bridge together: those of a call or a command line, of parameters, of a file.

A setting has the value of the command line, else that of the parameters of the node, else that of the configuration
file, else its default.  Lists of messages and of denied types are the exception: the command line adds to them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from igtl_gateway.app.rows import rows_of
from igtl_gateway.base.addons import check_setting
from igtl_gateway.base.errors import ConfigError
from igtl_gateway.config.configuration import LIVE, Config, read_toml
from igtl_gateway.config.setting import GATEWAY, HOST, IGTL, RECORD, ROWS, Value, unknown
from igtl_gateway.config.settings import all_settings, check_values, of_table, parameters
from igtl_gateway.config.triggers import text_of_table

#: Tables of a file, and the setting that they are.
TRIGGER = "trigger"
_FILES = ("tls_cert", "tls_key", "tls_ca")


def of_parameters(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the parameters that the node was started with.  Raises ConfigError."""
    known, values = parameters(), {}
    for name, found in overrides.items():
        if name not in known:
            check_setting(name)
            raise ConfigError(f"parameter {name}: {unknown(name, known)}")
        row = known[name]
        try:
            # ROS gives an empty list no type, and no value
            value: Any = () if row.is_list and not found and found is not False else row.check(found)
            values[name] = rows_of(row, value) if row.table == ROWS else value
        except ConfigError as error:
            raise ConfigError(f"parameter {name}: {error}") from None
    _check_rows(values)
    return values


def _check_rows(values: Mapping[str, Any]) -> None:
    try:
        Config.from_dict({name: values[name] for name in of_table(ROWS) if name in values})
    except ConfigError as error:
        raise ConfigError(f"parameter {error}") from None


def of_file(path: Path) -> dict[str, Any]:
    """Return the settings of a configuration file, with files as seen from its folder.  Raises ConfigError."""
    values = Config.from_toml(path).to_dict()
    for name in LIVE:
        if values.get(name) is None:
            values.pop(name, None)
    document = read_toml(path)
    try:
        if rules := document.get(TRIGGER):
            if not isinstance(rules, list):
                raise ConfigError(f"found {TRIGGER} = {rules!r}, expected tables [[{TRIGGER}]]")
            values[TRIGGER] = tuple(text_of_table(row, f"{TRIGGER}[{at}]") for at, row in enumerate(rules))
        for name, spelled in ((IGTL, _spelled_igtl), (HOST, dict), (RECORD, dict)):
            table = document.get(name, {})
            if not isinstance(table, Mapping):
                raise ConfigError(f"found {name} = {table!r}, expected a table [{name}]")
            values |= check_values(name, name, spelled(table))
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return values | {name: str(path.parent / file) for name in _FILES if (file := values.get(name))}


def _spelled_igtl(table: Mapping[str, Any]) -> dict[str, Any]:
    """``max_body``, a table in a file, as its option has it."""
    sizes = table.get("max_body", {})
    if not isinstance(sizes, Mapping):
        raise ConfigError(f"{IGTL}.max_body: found {sizes!r}, expected a table such as {{ STRING = 4 }}")
    return dict(table) | {"max_body": [f"{name}={mib}" for name, mib in sizes.items()]}


def settled(ours: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of all settings.

    Args:
        ours: name → value of the command line, or of a call.
        overrides: name → value of the parameters that the node was started with.

    Raises:
        ConfigError: for a wrong value, with its place.
    """
    parameter = of_parameters(overrides)
    path = ours.get("config") or parameter.get("config")
    file = of_file(Path(path)) if path else {}
    values: dict[str, Any] = {}
    for row in all_settings():
        found = [layer[row.name] for layer in (ours, parameter, file) if row.name in layer]
        if row.adds and row.name in ours and len(found) > 1:
            values[row.name] = (*found[0], *found[1])
        else:
            values[row.name] = found[0] if found else row.default
    return values


def config_of(values: Mapping[str, Any]) -> Config:
    """Return the configuration of a session for the values of all settings.  Raises ConfigError."""
    return Config.of_values({name: values[name] for name in (*of_table(GATEWAY), *of_table(ROWS))})


def declared(values: Mapping[str, Any], config: Config) -> dict[str, Value]:
    """Return the values of all parameters; rows of messages as JSON objects."""
    result = {name: values[name] for name in parameters()}
    for name in of_table(ROWS):
        rows = config.to_dict().get(name, ())
        usual = type(getattr(config, name)[0])() if rows else None
        result[name] = tuple(
            json.dumps({key: value for key, value in row.items() if value != getattr(usual, key)}) for row in rows
        )
    return result
