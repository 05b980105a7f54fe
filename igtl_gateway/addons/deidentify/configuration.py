"""The rules for the configuration: its rows name the same streams by their new names.

A glob that mixes a name with wildcards becomes one row for each stream of the session that it matches.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Collection, Iterable

from igtl_gateway.addon import matches
from igtl_gateway.addon.igtl import BODIES
from igtl_gateway.addon.settings import AUTO_PROFILE, Config, PeerRow, TfOutRow, ToRosRow
from igtl_gateway.addons.deidentify.context import Context
from igtl_gateway.addons.deidentify.notes import known_kinds, known_types

_WILD = re.compile(r"[*?]")
_BRACES = re.compile(r"(\{[^{}]*\})")


@dataclasses.dataclass(frozen=True, slots=True)
class SeenNames:
    """Names in the inputs of a session: devices of peers, ROS topics, addresses of peers."""

    devices: Collection[str]
    topics: Collection[str]
    addresses: Collection[str]


def clean_config(config: Config, seen: SeenNames, context: Context) -> Config:
    """Return the configuration for the new names."""
    names = context.names
    before = context.report.rules["name"]
    new = dataclasses.replace(
        config,
        base_frame=names.name(config.base_frame),
        deny_in=tuple(known_types(config.deny_in)),
        deny_out=tuple(known_types(config.deny_out)),
        kinds=tuple(known_kinds(config.kinds, context)),
        mark_from=_all_expanded(config.mark_from, seen.devices, names.name),
        allow_in=_all_expanded(config.allow_in, seen.devices, names.name),
        allow_out=_all_expanded(config.allow_out, {topic[1:] for topic in seen.topics}, _device_of_topic(names.topic)),
        crtk=tuple(
            dataclasses.replace(row, arms=arms, frame_id=names.name(row.frame_id))
            for row in config.crtk
            for arms in _expanded(row.arms, _namespaces(seen.topics), names.topic)
        ),
        to_igtl=tuple(
            dataclasses.replace(row, topic=topic, device=names.name(row.device), metadata=())
            for row in config.to_igtl
            for topic in _expanded(row.topic, seen.topics, names.topic)
        ),
        to_ros=tuple(
            dataclasses.replace(_ros_row(row, context), device=device)
            for row in config.to_ros
            for device in _expanded(row.device, seen.devices, names.name)
        ),
        tf_out=tuple(_tf_row(row, context) for row in config.tf_out),
        peers=tuple(
            PeerRow(at, row.profile)
            for row in config.peers
            for at in _expanded(row.at, seen.addresses, names.address)
            if row.profile != AUTO_PROFILE or not _WILD.search(row.at) or at != row.at
        ),
    )
    report = context.report
    report.add("setting", report.rules["name"] - before + sum(len(row.metadata) for row in config.to_igtl))
    report.rules["name"] = before
    return new


def _expanded(glob: str, seen: Iterable[str], new: Callable[[str], str]) -> list[str]:
    """Return the globs for the new names: the name, the wildcards, or the names of the session that match."""
    if not _WILD.search(glob):
        return [new(glob)]
    if all(not _WILD.search(part) or not part.strip("*?") for part in glob.split("/")):
        return ["/".join(part if _WILD.search(part) else new(part) for part in glob.split("/"))]
    return [new(name) for name in sorted(seen) if matches(glob, name)]


def _all_expanded(globs: Iterable[str], seen: Iterable[str], new: Callable[[str], str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for glob in globs for name in _expanded(glob, seen, new)))


def _device_of_topic(new: Callable[[str], str]) -> Callable[[str], str]:
    """Return the new name of a device that has the name of its topic."""
    return lambda device: new(f"/{device}")[1:]


def _namespaces(topics: Iterable[str]) -> set[str]:
    """Return all namespaces of topics, such as ``/a`` and ``/a/b`` of ``/a/b/c``."""
    parts = [topic.split("/") for topic in topics]
    return {"/".join(each[:end]) for each in parts for end in range(2, len(each))}


def _ros_row(row: ToRosRow, context: Context) -> ToRosRow:
    names = context.names
    topic = "".join(part if part.startswith("{") else names.topic(part) for part in _BRACES.split(row.topic))
    return dataclasses.replace(
        row,
        type=row.type if row.type in BODIES or not row.type.strip("*?") else _type_glob(row.type),
        topic=topic,
        frame_id=names.name(row.frame_id),
        child_frame_id=names.name(row.child_frame_id),
        kinds=tuple(known_kinds(row.kinds, context)),
    )


def _type_glob(glob: str) -> str:
    """Return a glob of types if it matches a known one, else one that matches nothing."""
    return glob if any(matches(glob, name) for name in BODIES) else "-"


def _tf_row(row: TfOutRow, context: Context) -> TfOutRow:
    names = context.names
    frames = tuple(names.name(frame) for frame in row.frames)
    return dataclasses.replace(row, frames=frames, base=names.name(row.base), device=names.name(row.device))
