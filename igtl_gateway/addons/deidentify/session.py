"""De-identifies a session: reads the inputs, changes them, computes the outputs again, and verifies the result."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from igtl_gateway.addon import DamagedRecording, GatewayError, Unavailable, UnsupportedRecording, WireError, __version__
from igtl_gateway.addon.checking import (
    IMPORTED,
    UNSEALED,
    SealVerification,
    Session,
    make_core,
    verify_recording,
    verify_seal,
)
from igtl_gateway.addon.igtl import BODIES, Bind, visible
from igtl_gateway.addon.messages import NAME_ITEM, header_names, restore_metadata, short_device_name
from igtl_gateway.addon.reading import (
    Entry,
    Head,
    Heads,
    Kind,
    Level,
    Note,
    Qos,
    RecordedStamps,
    Rows,
    SessionFile,
    added_marks,
    carry_marks,
    config_to_run,
    input_groups,
    layout,
    recorded_acceptance,
    rows_of,
)
from igtl_gateway.addon.settings import Config
from igtl_gateway.addon.writing import Definition, SessionWriter, written
from igtl_gateway.addons.deidentify import patterns
from igtl_gateway.addons.deidentify.configuration import SeenNames, clean_config
from igtl_gateway.addons.deidentify.context import Context, Removed
from igtl_gateway.addons.deidentify.messages import MessageCleaner
from igtl_gateway.addons.deidentify.notes import clean_mark, clean_note
from igtl_gateway.addons.deidentify.profile import Profile
from igtl_gateway.addons.deidentify.repeated import Repeated
from igtl_gateway.addons.deidentify.report import Report
from igtl_gateway.addons.deidentify.ros import RosCleaner, bare_definition
from igtl_gateway.addons.deidentify.unused import unused_rows

#: Code of the note at the end of the result, and key of its metadata.
DEIDENTIFIED = "deidentified"
#: Key of the metadata for the seal of the recording.
DERIVED_FROM = "derived_from"
#: Metadata that stay if they are numbers: they decide how a session is verified.
_KEPT = ("igtl_gateway_version", layout.PART_KEY, layout.SNAPSHOT_KEY)
_NUMBERS = re.compile(r"[0-9]{1,9}([.][0-9]{1,9}){0,3}", re.ASCII)
_INPUTS = (Kind.IGTL_IN, Kind.ROS_IN)
_NAME = NAME_ITEM.encode()


def deidentify(
    path: Path, out: Path, profile: Profile, key: bytes, *, shift_ns: int | None = None, overwrite: bool = False
) -> Report:
    """Write the session without identity; the file is complete or absent, readable by its owner only, and verifies.

    Args:
        path: the session.
        out: the file to write.
        profile: what stays.
        key: secret of the pseudonyms and of the shift.
        shift_ns: shift of all times, ns; None: from the key; 0: none.
        overwrite: replace an existing file.

    Raises:
        UnsupportedRecording: the file is of another program.
        DamagedRecording: the file is damaged.
        GatewayError: the result would not verify, or the file cannot be written.
    """
    try:
        with written(out, overwrite=overwrite) as place:
            with SessionFile.open(path) as file:
                if file.merge:
                    one = path / file.merge.names[0]
                    raise UnsupportedRecording(
                        f"{path}: found a merged session, expected one of its parts, such as {one}"
                    )
                if file.foreign:
                    raise UnsupportedRecording(
                        f"{path}: found an MCAP file of another program, expected a session; import it first"
                    )
                run = _Run(file, Context.of(profile, key, shift_ns), _seal_of(path))
                run.write(place)
            if IMPORTED not in file.session and not verify_recording(place).good:
                raise GatewayError(f"{path}: found outputs that the gateway does not compute from the new inputs")
        carry_marks(out, run.added)
        return run.report
    except layout.LayoutError as error:
        raise DamagedRecording(f"{path}: {error}") from None
    except GatewayError:
        raise
    except OSError as error:
        raise GatewayError(f"cannot write to {out}: {error.strerror}") from None
    finally:
        patterns.close()


def _may_have_others(head: Head) -> bool:
    """Return whether each message may have other names: links, and children of a BIND."""
    return head.kind is Kind.LINK or head.type == "BIND"


def _seal_of(path: Path) -> SealVerification | None:
    """Return the result of ``verify --seal``; None for a recording without seals, or if nothing can check them."""
    try:
        found = verify_seal(path)
    except (Unavailable, UnsupportedRecording):  # no cryptography; a part of a merged session, which has no seals
        return None
    return None if found.state == UNSEALED else found


@dataclasses.dataclass(slots=True)
class _Numbers:
    """Number and time (UTC ns) of the last entry."""

    seq: int = 0
    stamp_ns: int = 0


class _Run:
    """One de-identification."""

    def __init__(self, file: SessionFile, context: Context, seal: SealVerification | None) -> None:
        self._file, self._context, self._seal = file, context, seal
        self.report = context.report
        if seal and not seal.good:
            self.report.left["seal"] = f"the result does not name it: the recording is {seal.state}, expected sealed"
        self._acceptance = recorded_acceptance(file)
        self._messages = MessageCleaner(context, self._acceptance)
        self._ros = RosCleaner(context, self._messages, file.definitions)
        self._repeated = Repeated(context, self._ros.layout.places)
        self._is_import = IMPORTED in file.session
        #: The marks of the side file, without identity.
        self.added = [clean_mark(mark, context) for mark in added_marks(file.path, file.start_ns, file.end_ns)]
        seen = self._look()
        config = config_to_run(file.session) if not self._is_import else Config()
        self._config = clean_config(config, seen, context)
        self._qos: dict[tuple[str, str], Qos | None] = {}
        self._recorded_qos = {(each.topic, each.type): each.qos for each in reversed(file.channels)}

    def write(self, path: Path) -> None:
        """Write the new session."""
        # the fast path has the result of the full path, and the new session is verified
        numbers = _Numbers()
        session = Session(make_core(self._config), numbers)
        before: list[Entry] = []
        for group in input_groups(self._file.prologue()):
            for entry in self._cleaned((group.input,)):
                outputs = list(self._cleaned(group.outputs))
                session.restored(entry, outputs)
                before += (entry, *outputs)

        def qos_of(topic: str, ros_type: str) -> Qos | None:
            return self._qos.get((topic, ros_type)) or session.gateway.qos(topic)

        writer = SessionWriter(
            path, self._facts(), qos_of=qos_of, definition_of=self._definition_of, compression="zstd",
            prologue=before,
        )  # fmt: skip
        numbers.seq, numbers.stamp_ns = 0, 0  # the prologue is not in the session
        seq, stamp_ns = 0, 0
        for entry in self._cleaned_inputs():
            seq, stamp_ns = self._add(writer, session, entry, seq, stamp_ns)
        self.report.unused = unused_rows(self._context.profile, self._context.asked)
        self._add(writer, session, self._note(stamp_ns), seq, stamp_ns)
        writer.close({} if self._is_import else {"streams": session.gateway.ledger.to_dict()})

    def _add(self, writer: SessionWriter, session: Session, entry: Entry, seq: int, stamp_ns: int) -> tuple[int, int]:
        """Write an input and its outputs after an entry; return number and time of the last one."""
        if self._is_import:
            entries = [dataclasses.replace(entry, seq=seq + 1, stamp_ns=max(entry.stamp_ns, stamp_ns + 1))]
        else:
            entries = session.input(
                entry.stamp_ns, entry.kind, entry.payload, channel=entry.channel, type_name=entry.type,
                links=entry.links, source_ns=entry.source_ns,
            )  # fmt: skip
        for each in entries:
            writer.write(each)
        self.report.inputs += 1
        self.report.outputs += len(entries) - 1
        return entries[-1].seq, entries[-1].stamp_ns

    def _inputs(self) -> Iterator[Entry]:
        # the new session states no corrections: its messages have them
        stamps, heads = RecordedStamps(self._file), Heads()
        entries = chain.from_iterable(rows.entries(heads) for rows in self._input_rows(heads))
        return map(stamps.entry, entries) if stamps else entries

    def _cleaned_inputs(self) -> Iterator[Entry]:
        """Yield the new inputs; those that repeat others of their stream are changed many at once."""
        if RecordedStamps(self._file):
            yield from self._cleaned(self._inputs())
            return
        heads = Heads()
        for rows in self._input_rows(heads):
            changed = self._repeated.rows(rows, heads)
            for row, new in enumerate(changed):
                if new is not None:
                    yield new
                else:
                    yield from self._cleaned((rows.entry(row, heads),))
            changed.count(self._context)

    def _input_rows(self, heads: Heads) -> Iterator[Rows]:
        """The inputs as rows: outputs, such as large pictures, become no objects."""
        are_inputs = np.zeros(0, np.bool_)
        for rows in rows_of(self._file, heads):
            if len(are_inputs) < len(heads.known):
                are_inputs = np.array([head.kind.is_input for head in heads.known])
            yield rows.where(are_inputs[rows.heads])

    def _prologue(self) -> Iterator[Entry]:
        return (entry for entry in self._file.prologue() if entry.kind.is_input)

    def _cleaned(self, entries: Iterable[Entry]) -> Iterator[Entry]:
        for entry in entries:
            if (same := self._repeated.apply(entry)) is not None:
                yield same
                continue
            before = self.report.rules.copy()
            try:
                new = self._clean(entry)
            except Removed as removed:
                self.report.add(removed.rule)
                self.report.removed[self._stream_name(entry)] += 1
                continue
            changes = self.report.rules - before
            del changes["kept type"]
            if changes:
                counts = self.report.streams.setdefault(new.channel or "notes", changes.__class__())
                counts.update(dict.fromkeys(changes, 1))
            self._repeated.learn(entry, new, changes)
            yield new

    def _clean(self, entry: Entry) -> Entry:
        stamp_ns = self._context.times.ns(entry.stamp_ns)
        match entry.kind:
            case Kind.IGTL_IN:
                data = self._messages.clean(entry.data(), entry.channel)
                channel, type_name, source_ns = header_names(data)
                return Entry(entry.seq, stamp_ns, entry.kind, channel, type_name, (data,), entry.links, source_ns)
            case Kind.ROS_IN:
                data = self._ros.clean(entry.type, entry.data(), entry.channel)
                topic, source_ns = self._context.names.topic(entry.channel), self._context.times.ns(entry.source_ns)
                self._qos[topic, entry.type] = self._recorded_qos.get((entry.channel, entry.type))
                return Entry(entry.seq, stamp_ns, entry.kind, topic, entry.type, (data,), entry.links, source_ns)
            case Kind.ROS_OUT:  # a command to a robot, in a prologue: its topic is its device
                data = self._ros.clean(entry.type, entry.data(), entry.channel)
                topic = f"/{self._context.names.name(entry.channel.removeprefix('/'))}"
                return Entry(entry.seq, stamp_ns, entry.kind, topic, entry.type, (data,))
            case _:
                note = clean_note(entry.data(), self._context)
                return Entry(entry.seq, stamp_ns, entry.kind, payload=(note,), links=entry.links)

    def _stream_name(self, entry: Entry) -> str:
        """Return the new stream of a removed message; an unknown type of a peer may be any text."""
        label = self._context.names.label
        if entry.kind is Kind.ROS_IN:
            return "/".join(map(label, entry.channel.split("/")))
        kind = entry.type if entry.type in BODIES else "(unknown type)"
        return f"{kind}/{label(entry.channel.partition('/')[2])}"

    def _look(self) -> SeenNames:
        """Read the inputs once for the names in them."""
        devices: set[str] = set()
        topics: set[str] = set()
        addresses: set[str] = set()
        for entry in chain(self._prologue(), self._inputs_with_names()):
            if entry.kind in _INPUTS:
                self._context.asked.streams.add(entry.channel)
            self._look_at(entry, devices, topics, addresses)
        return SeenNames(devices, topics, addresses)

    def _inputs_with_names(self) -> Iterator[Entry]:
        """Yield the inputs that may have a name which those before do not have."""
        heads = Heads()
        for rows in self._input_rows(heads):
            if any(_NAME in buffer for buffer in rows.buffers):
                yield from rows.entries(heads)
                continue
            found, first, places = np.unique(rows.heads, return_index=True, return_inverse=True)
            chosen = np.array([_may_have_others(heads.known[head]) for head in found.tolist()], np.bool_)[places]
            chosen[first] = True
            yield from rows.where(chosen).entries(heads)

    def _look_at(self, entry: Entry, devices: set[str], topics: set[str], addresses: set[str]) -> None:
        if entry.kind is Kind.ROS_IN:
            topics.add(entry.channel)
            name = entry.channel.rpartition("/")[2]
            self._context.names.full.setdefault(short_device_name(name), name)
        elif entry.kind is Kind.LINK:
            addresses.add(str(Note.of(entry.data()).data.get("peer", "")))
        elif entry.kind is Kind.IGTL_IN:
            name = entry.channel.partition("/")[2]
            data = entry.data()
            if _NAME in data or entry.type == "BIND":
                try:
                    message = self._acceptance.message(data)
                except WireError:
                    return
                name = restore_metadata(message).device_name
                self._context.names.full.setdefault(short_device_name(name), name)
                if isinstance(message.content, Bind):
                    devices.update(visible(child.name) for child in message.content.children)
            devices.add(name)

    def _facts(self) -> dict[str, str]:
        given = self._file.session
        facts = {key: given[key] for key in _KEPT if _NUMBERS.fullmatch(given.get(key, ""))}
        if self._is_import:
            facts[IMPORTED] = "removed"
        beside = sum(1 for _ in self._file.beside())  # attachments and metadata of an imported file, which are left out
        self.report.add("session", beside + len(self._file.session.keys() - facts.keys() - {layout.CONFIGURATION_KEY}))
        if self._seal and self._seal.good:
            facts[DERIVED_FROM] = f"sealed recording, SHA-256 of its last seal: {self._seal.parts[-1].last_seal}"
        options = ", ".join(self.report.options)
        return {
            **facts,
            layout.CONFIGURATION_KEY: json.dumps(self._config.to_dict()),
            DEIDENTIFIED: f"by igtl-gateway {__version__}; options of DICOM PS3.15: {options}",
        }

    def _definition_of(self, ros_type: str) -> Definition | None:
        """Return the definition of a kept type without its comments; None: the usual one."""
        text = self._file.definitions.get(ros_type, "")
        if not text or not self._context.keeps_type(ros_type):
            return None
        bare = bare_definition(text, ros_type)
        return Definition(bare.encode()) if bare else None

    def _note(self, stamp_ns: int) -> Entry:
        facts = self.report.to_dict()
        rules = {row["rule"]: row["changes"] for row in facts["rules"]}
        data = {name: facts[name] for name in ("options", "removed", "left", "not_covered")} | {"rules": rules}
        text = f"de-identified by igtl-gateway {__version__}; see the rules and what they do not cover"
        return Entry(0, stamp_ns + 1, Kind.EDGE_NOTE, payload=(Note(Level.INFO, DEIDENTIFIED, text, "", data).pack(),))
