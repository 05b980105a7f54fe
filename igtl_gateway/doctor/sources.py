"""The sources that a configuration names, as a session or a look at the graph has them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.globs import matches
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.convert.frames import FrameTree
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.observations import ObservedPeer, ObservedStream, ObservedTopic
from igtl_gateway.gateway.expected import (
    NO_SOURCE,
    SOURCE_CAME,
    ExpectedSource,
    MissingSource,
    PresentSources,
    expected_sources,
    missing_sources,
)
from igtl_gateway.gateway.log.note import Note

#: Topics of the tf tree.
TF_TOPICS = frozenset({"/tf", "/tf_static"})
#: Messages of the tf tree that are read whole; of later ones those that name a frame that has not come.
_READ = 1_000
#: Notes about sources that are kept.
_MAX_NOTES = 100


class ObservedSources:
    """What of a configuration is there.

    Args:
        config: the configuration.

    Attributes:
        expected: the sources that are looked for.
        is_recording: whether the session is over: what has no message in it has not come.
        selected: globs of the streams that were recorded only, and of those that were not; a recording has no others.
        links: address of a server that the configuration names → whether it answers; None: not looked at.
        reads_tf: whether the tf tree was looked at.
    """

    def __init__(self, config: Config) -> None:
        self.is_recording = self.reads_tf = False
        self.selected: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
        self.links: Mapping[str, bool] | None = None
        self.expected = expected_sources(config)
        self._tree = FrameTree()
        self._requests = [row.request() for row in config.tf_out]
        frames = {frame for one in self._requests for frame in (*one.frames, one.base)}
        self._awaited = {frame: frame.encode() + b"\0" for frame in frames}  # frame → its end in a message
        self._read = 0
        self._unmet: dict[str, Note] = {}

    def noted(self, note: Note) -> None:
        """Take a note of the session: one that a source has not come, or that it has."""
        if note.code == NO_SOURCE and len(self._unmet) < _MAX_NOTES:
            self._unmet.setdefault(note.stream, note)
        elif note.code == SOURCE_CAME:
            self._unmet.pop(note.stream, None)

    def transforms(self, topic: str, data: bytes) -> None:
        """Take a message of the tf tree, as CDR."""
        self.reads_tf = True
        self._read += 1
        if not self._awaited or (self._read > _READ and not any(end in data for end in self._awaited.values())):
            return
        try:
            self._tree.update(TFMessage.unpack(data), topic == "/tf_static")
        except ConversionError:
            return
        for frame in self._awaited.keys() & self._tree.names():
            del self._awaited[frame]

    def missing(
        self,
        streams: Iterable[ObservedStream],
        topics: Mapping[str, ObservedTopic],
        peers: Iterable[ObservedPeer],
        graph: Graph | None,
    ) -> Iterator[tuple[str, str, str]]:
        """Yield name, sentence and setting of each source that is not there."""
        devices: dict[str, set[str]] = {}
        for stream in streams:
            devices.setdefault(stream.raw_device, set()).add(stream.raw_type)
        listed = list(peers)
        addresses = {each for one in listed for each in (one.address, one.local, one.asked) if each}
        published: Mapping[str, Iterable[str]] | None = graph.published if graph else None
        if self.is_recording:
            published = {name: [one.type] for name, one in topics.items()}
        present = PresentSources(
            topics=None if published is None else {name: frozenset(types) for name, types in published.items()},
            frames=self._tree.names() if self.is_recording or self.reads_tf else None,
            devices=devices if devices or self.is_recording or self.links is not None else None,
            links=None if self.links is None else [address for address, answers in self.links.items() if answers],
            peers=addresses or None,
            connected=len(listed),
            apart=self._apart(),
        )
        found = missing_sources([each for each in self.expected if self._is_selected(each)], present)
        for each in found:
            yield each.source.name, each.text, each.source.setting
        yield from self._unmet_of(found, {*topics, *devices})

    def _unmet_of(self, found: Iterable[MissingSource], there: set[str]) -> Iterator[tuple[str, str, str]]:
        """Yield the sources that the session has noted, and that are not known by what it has."""
        known = there | {each.source.name for each in found}
        for name, note in self._unmet.items():
            if name not in known:
                yield name, note.text, str(note.data.get("setting", ""))

    def _apart(self) -> dict[str, str]:
        names, root_of = self._tree.names(), self._tree.root_of
        return {
            frame: one.base
            for one in self._requests
            for frame in one.frames
            if {frame, one.base} <= names and root_of(frame) != root_of(one.base)
        }

    def _is_selected(self, source: ExpectedSource) -> bool:
        """Return whether a recording would have the source."""
        included, excluded = self.selected
        if source.kind not in ("topic", "arm", "device"):
            return True
        if any(matches(glob, source.name) for glob in excluded):
            return False
        return not included or any(matches(glob, source.name) for glob in included)
