"""The unit of lengths in the messages of each stream of a session."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress

from igtl_gateway.base.errors import WireError
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.units import UNITS
from igtl_gateway.gateway.acceptance import Acceptance
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import LINK_UP, Note
from igtl_gateway.gateway.peers import Peers
from igtl_gateway.gateway.streams import Streams, is_of_arm
from igtl_gateway.gateway.to_igtl.sender import ARM_UNIT


def arm_units(notes: Iterable[Entry]) -> dict[int, str]:
    """Return link → unit of arms, of the peers with a unit of their own, from the notes of a session."""
    found: dict[int, str] = {}
    for entry in notes:
        if entry.kind is Kind.NOTE and (note := Note.unpack(entry.data())).code == ARM_UNIT:
            if (unit := note.data.get("unit")) in UNITS:
                found |= dict.fromkeys(entry.links, unit)
    return found


def arm_units_before(config: Config, inputs: Iterable[Entry]) -> dict[int, str]:
    """Return the same of the peers whose first messages are inputs before a file that begins midway."""
    peers = Peers(config)
    for entry in inputs:
        for link in entry.links if entry.kind in (Kind.LINK, Kind.IGTL_IN) else ():
            if entry.kind is Kind.LINK:
                note = Note.of(entry.data())
                if note.code == LINK_UP:
                    peers.up(link, note.data, entry.stamp_ns)
                else:
                    peers.down(link)
            elif peer := peers.get(link):
                with suppress(WireError):  # a damaged message shows nothing
                    peer.learn_from(Acceptance.of(config).message(entry.data()))
    return {peer.link: peer.profile.arm_unit for peer in peers.all() if peer.profile.arm_unit}


class StreamUnits:
    """The unit of each stream: that of its row in the configuration, or of its arm.

    An output has the unit of the stream that it is made of.  Outputs of several streams, such as /tf, and those of
    streams that are not known yet have the unit of the session.

    Args:
        config: the configuration of the session.
        streams: its streams in the order of their appearance: kind, name and type of their entries.
        links: link → unit of arms for its peer, see ``arm_units``.
    """

    def __init__(
        self,
        config: Config,
        streams: Iterable[tuple[Kind, str, str]] = (),
        links: Mapping[int, str] | None = None,
    ) -> None:
        self._links = links or {}
        self._arms: dict[tuple[Kind, str], bool] = {}
        self._config = config
        self._streams = Streams(config)
        self._units: dict[tuple[Kind, str], str] = {}
        self._is_sent_of_arm: dict[str, bool] = {}  # device → whether its topic is that of an arm
        for request in config.tf_out:
            unit = config.lengths(request).igtl
            self._units[Kind.IGTL_OUT, self._streams.device(request.request().device)] = unit
        for kind, name, type_name in streams:
            self.of(kind, name, type_name)

    def of(self, kind: Kind, name: str, type_name: str, links: Sequence[int] = ()) -> str:
        """Return the unit of a stream, a key of ``convert.units.UNITS``.

        Args:
            kind: kind of its entries.
            name: their channel: the topic, or TYPE/device.
            type_name: their type.
            links: those that an entry came from or went to, of which each may have a unit of its own.
        """
        if self._links and links and kind in (Kind.IGTL_IN, Kind.IGTL_OUT) and self._is_of_arm(kind, name):
            if unit := self._links.get(links[0]):
                return unit
        return self._of(kind, name, type_name)

    def of_links(self, kind: Kind, name: str, type_name: str) -> Mapping[int, str]:
        """Return the links whose messages of a stream have a unit of their own, with that unit."""
        return self._links if self._links and self._is_of_arm(kind, name) else {}

    def _is_of_arm(self, kind: Kind, name: str) -> bool:
        """Return whether a stream of OpenIGTLink is a pose of an arm, in the unit of its peer."""
        key = (kind, name)
        if key not in self._arms:
            igtl_type, _, device = name.partition("/")
            if kind is Kind.IGTL_IN:
                row = self._config.row_to_ros(igtl_type, device)
                self._arms[key] = is_of_arm(self._config, row, device)
            else:
                self._arms[key] = self._is_sent_of_arm.get(device, False)
        return self._arms[key]

    def _of(self, kind: Kind, name: str, type_name: str) -> str:
        key = (kind, name)
        match kind:
            case Kind.IGTL_IN if key not in self._units:
                igtl_type, _, device = name.partition("/")
                self._units[key] = self._config.lengths(self._config.row_to_ros(igtl_type, device)).igtl
                if shown := self._streams.to_ros(igtl_type, device):
                    for conversion, topic in shown.outputs:
                        if not conversion.topic:
                            self._units.setdefault((Kind.ROS_OUT, topic), shown.lengths.ros)
            case Kind.ROS_IN if key not in self._units:
                row = self._config.row_to_igtl(name)
                self._units[key] = self._config.lengths(row).ros if row else self._config.ros_unit
                if sent := self._streams.to_igtl(name, type_name):
                    self._units.setdefault((Kind.IGTL_OUT, sent.device), sent.lengths.igtl)
                    self._is_sent_of_arm.setdefault(sent.device, sent.of_robot)
            case Kind.IGTL_OUT:
                return self._units.get((kind, name.partition("/")[2]), self._config.igtl_unit)
        return self._units.get(key, self._config.ros_unit)
