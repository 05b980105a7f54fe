"""The files of a recording: each is opened with the options of the recording, and known to the bridge."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from igtl_gateway.base.clock import Clock
from igtl_gateway.base.errors import ConfigError, RecordingError, Unavailable
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.seal.keys import SigningKey
from igtl_gateway.record.sessionfile import layout
from igtl_gateway.record.sessionfile.large_outputs import LargeOutputs
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.sealing import SealSeries
from igtl_gateway.record.sessionfile.writer import QosOf, SessionWriter


class NewFiles:
    """Opens the files of a recording.

    Args:
        session: metadata of all of them.
        options: of the recording.
        clock: of the seals.
        qos_of: QoS of a topic.

    Attributes:
        session: the metadata, with the selection and the user's own.
        types: definitions of ROS messages.
        outputs: how the files have large outputs.
        all: absolute paths of the files that were begun.

    Raises RecordingError for a key that cannot be used.
    """

    def __init__(self, session: Mapping[str, str], options: RecordOptions, clock: Clock, qos_of: QosOf) -> None:
        self.session = dict(session) | options.selection.facts()
        if options.custom:
            self.session[layout.CUSTOM_KEY] = json.dumps(dict(options.custom), sort_keys=True)
        self.types = RosTypes()
        self.outputs = LargeOutputs(options.outputs)
        self.all: set[Path] = set()
        self._options = options
        self._qos_of = qos_of
        self._seals = _seal_series(options, clock)
        self._begun: list[str] = []  # files that the bridge does not know yet
        self._announce: Callable[[list[str]], None] | None = None

    def open(self, path: Path, more: dict[str, str], prologue: Sequence[Entry]) -> SessionWriter:
        """Begin a file with further metadata and these entries.  Raises RecordingError."""
        options = self._options
        sealer = self._seals.next_file(path, alone=not options.has_parts) if self._seals else None
        writer = SessionWriter(
            path,
            self.session | more,
            qos_of=self._qos_of,
            compression=options.compression,
            together=True,
            chunk_bytes=options.chunk_bytes,
            fsync=options.fsync,
            overwrite=options.overwrite,
            prologue=prologue,
            types=self.types,
            sealer=sealer,
            counted=True,
            outputs=self.outputs,
        )
        if self._seals and sealer:
            self._seals.has_begun(sealer)
        self._begun.append(str(path))
        self.all.add(path.absolute())
        if self._announce:
            self._announce(self.take_begun())
        return writer

    def take_begun(self) -> list[str]:
        """Return the files that were begun and not named yet."""
        begun, self._begun = self._begun, []
        return begun

    def announce_by(self, announce: Callable[[list[str]], None]) -> None:
        """From now on, name files as they begin: if this process is killed, the bridge knows them."""
        self._announce = announce


def _seal_series(options: RecordOptions, clock: Clock) -> SealSeries | None:
    """The seals of the recording, if there are any.  Raises RecordingError for a key that cannot be used."""
    if options.seal is None:
        return None
    try:
        return SealSeries(SigningKey.load(options.seal), clock.utc_ns)
    except (ConfigError, Unavailable) as error:
        raise RecordingError(f"cannot seal the recording: {error}") from None
