"""Rows of messages as strings of options and parameters: topics, frames, messages and peers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.setting import Setting
from igtl_gateway.config.settings import PROFILE_NAMES
from igtl_gateway.convert.frames import TfRequest
from igtl_gateway.convert.table import TO_ROS


def with_sends(config: Config, sends: Sequence[str]) -> Config:
    """Return ``config`` with a first row for each ``TOPIC[=DEVICE[:TYPE]]``.  Raises ConfigError."""
    values = config.to_dict()
    return Config.from_dict(values | {"to_igtl": [*map(send_row, sends), *values["to_igtl"]]})


def send_row(text: str) -> dict[str, str]:
    """Return the row of ``[[to_igtl]]`` for ``TOPIC[=DEVICE[:TYPE]]``.  Raises ConfigError."""
    topic, _, rest = text.partition("=")
    device, _, igtl_type = rest.partition(":")
    if not topic.startswith("/"):
        raise ConfigError(f"--send: found {text!r}, expected /topic, /topic=Device or /topic=Device:TYPE")
    return {"topic": topic, "device": device, "type": igtl_type}


def rows_of(setting: Setting, texts: Iterable[str]) -> tuple[dict[str, Any], ...]:
    """Return the rows of messages that strings stand for: each as its option has it, or as a JSON object.

    A JSON object has the keys of the table of a configuration file, such as ``{"topic": "/camera/image_raw"}``.
    Raises ConfigError.
    """
    short = []
    rows: list[dict[str, Any]] = []
    for text in texts:
        if text.lstrip().startswith("{"):
            rows.append(_json_row(text))
        else:
            short.append(text)
    if setting.name == "to_ros":
        return (*_kinds_rows(short), *rows)
    return (*map(_ROW[setting.name], short), *rows)


def _json_row(text: str) -> dict[str, Any]:
    try:
        row = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"found {text!r}, expected a JSON object: {error}") from None
    assert isinstance(row, dict)  # it begins with a brace
    return row


def _kinds_rows(texts: list[str]) -> list[dict[str, Any]]:
    kinds: dict[str, list[str]] = {}
    for device, named in map(_kinds_row, texts):
        kinds.setdefault(device, []).extend(named)
    return [{"device": device, "kinds": named} for device, named in kinds.items()]


def _tf_row(text: str) -> dict[str, Any]:
    request = TfRequest.parse(text)
    return {"frames": request.frames, "base": request.base, "device": request.device, "type": request.type}


def _kinds_row(text: str) -> tuple[str, list[str]]:
    device, equals, kinds = text.partition("=")
    known = {row.kind for row in TO_ROS}
    named = [kind.strip() for kind in kinds.split(",")]
    wrong = [kind for kind in named if kind.removeprefix("+") not in known]
    if not device or not equals or wrong:
        expected = one_of(next(iter(wrong), "").removeprefix("+"), sorted(known))
        raise ConfigError(f"--kinds: found {text!r}, expected DEVICE=KIND[,KIND…] with {expected}")
    return device, named


def _peer_row(text: str) -> dict[str, str]:
    place, _, profile = text.rpartition("=")
    if not place or profile not in PROFILE_NAMES:
        raise ConfigError(f"--peer: found {text!r}, expected HOST:PORT=PROFILE, {one_of(profile, PROFILE_NAMES)}")
    return {"at": place, "profile": profile}


def _arms_row(text: str) -> dict[str, str]:
    return {"arms": text}


#: Setting → the row of one text.
_ROW: dict[str, Callable[[str], dict[str, Any]]] = {
    "to_igtl": send_row,
    "tf_out": _tf_row,
    "peers": _peer_row,
    "crtk": _arms_row,
}
