"""The file of a world: recorded by the product's own core and recorder, and changed by its verbs.

All of it happens in this process: ``product`` runs a verb as its users do, and returns what it prints.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

from mcap.reader import make_reader
from mcap.writer import Writer

from igtl_gateway.app.recording import state_rule
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.qos import Qos
from igtl_gateway.cli import main
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.record.host import in_thread
from igtl_gateway.record.options import RecordOptions
from igtl_gateway.record.recorder import Recorder
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.sessionfile.writer import SessionWriter
from tools.truth.senders import ROS_TYPES, Plan, Sent
from tools.truth.world import BEGIN_NS

_TYPES = RosTypes()
_DEADLINE_S = 60.0
_ROUNDED_NS = 40 * 10**6
#: Seconds of a part, of a snapshot, and of a slice.
PART_S, SNAPSHOT_S, SLICE_S = 0.7, 0.9, (0.6, 1.4)
_PROFILE = '[keep]\nnames = ["**", "*"]\n[[text]]\nstream = "**"\naction = "keep"\n'
#: ``deidentify`` moves all times by this number of seconds.
SHIFT_S = -86400


@dataclass(frozen=True)
class Printed:
    """What a verb stated: exit code and both outputs."""

    code: int
    text: str


@dataclass
class Recording:
    """The file of a world.

    Attributes:
        path: of it.
        stated: what the verbs that changed it printed.
        shift_ns: by which all of its times are moved.
        rounded_ns: step of its times of receipt, which are then up to that early.
        whole: whether it has all messages.
        refused: the reason of a verb that refused it; the file is the one before.
    """

    path: Path
    stated: str = ""
    shift_ns: int = 0
    rounded_ns: int = 0
    whole: bool = True
    refused: str = ""


def product(*words: object) -> Printed:
    """Run a verb in this process; none of its lines is wrapped."""
    output = io.StringIO()
    wide = patch.dict(os.environ, {"COLUMNS": "10000"})
    with wide, contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    return Printed(code, output.getvalue())


def _qos(topic: str, _type: str) -> Qos | None:
    return Qos(depth=100, reliable=True, latched=True) if topic == "/tf_static" else None


def _entries(plan: Plan, messages: list[Sent], recorder: int) -> list[Entry]:
    config = Config(**plan.config)
    session = Session(Gateway(config))
    offset_ns = plan.recorder_offset_ns if recorder else 0
    entries: list[Entry] = []
    links = {sender.link for sender in plan.senders if sender.link and sender.recorder == recorder}
    for link in sorted(links):
        facts = {"peer": f"127.0.0.1:{50000 + link}", "local": "127.0.0.1:18944", "role": "server"}
        note = Note(Level.INFO, LINK_UP, "connected", data=facts).pack()
        entries += session.input(BEGIN_NS + offset_ns - 10**8 + link, Kind.LINK, (note,), links=(link,))
    for sent in messages:
        stream, now_ns = sent.stream, BEGIN_NS + sent.receipt_ns + offset_ns
        if stream.sender.recorder != recorder:
            continue
        if not stream.is_ros:
            entries += session.input(now_ns, Kind.IGTL_IN, (sent.data,), links=(stream.sender.link,))
            continue
        entries += session.input(
            now_ns,
            Kind.ROS_IN,
            (sent.data,),
            channel=stream.key,
            type_name=ROS_TYPES[stream.kind],
            # DDS stamps every message with the clock of its sender, also if the header has none
            source_ns=stream.sender.shows(sent.receipt_ns - stream.sender.delay_ns) if stream.sender.stamped else 0,
        )
    return entries


def _write(plan: Plan, path: Path, entries: list[Entry]) -> None:
    config = Config(**plan.config)
    writer = SessionWriter(path, {"config": json.dumps(config.to_dict())}, types=_TYPES, qos_of=_qos)
    for entry in entries:
        writer.write(entry)
    writer.close({})


def _record(plan: Plan, path: Path, entries: list[Entry], options: RecordOptions, *, snapshot: bool = False) -> Path:
    config = Config(**plan.config)
    recorder = Recorder(
        path,
        {"config": json.dumps(config.to_dict())},
        qos_of=_qos,
        on_note=lambda note: None,
        clock=ManualClock(BEGIN_NS),
        host=in_thread,
        options=options,
        rule=state_rule(config),
    )
    for entry in entries:
        recorder(entry)
    taken = recorder.snapshot().result(_DEADLINE_S) if snapshot else None
    summary = recorder.close({})
    return taken or summary.files[0]


def make(plan: Plan, folder: Path) -> Recording:
    """Write the file of a world, and let the verbs of its plan change it."""
    messages = plan.messages()
    entries = _entries(plan, messages, 0)
    first = next((one for one in plan.files if one in ("parts", "one_part", "snapshot")), "")
    path = folder / "session.mcap"
    recording = Recording(path)
    if first in ("parts", "one_part"):
        _record(plan, path, entries, RecordOptions(split_s=PART_S))
        recording.path = folder / "session"
        if first == "one_part":
            parts = sorted(recording.path.glob("*.mcap"))
            recording.path, recording.whole = parts[min(1, len(parts) - 1)], False
    elif first == "snapshot":
        recording.path = _record(plan, path, entries, RecordOptions(snapshot_s=SNAPSHOT_S), snapshot=True)
        recording.whole = False
    else:
        _write(plan, path, entries)
    for number, verb in enumerate(plan.files):
        if verb in _VERBS:
            new = folder / f"{number}-{verb}.mcap"
            before = replace(recording)
            done = _VERBS[verb](plan, recording, folder, new, messages)
            recording.stated += done.text
            if new.exists():
                recording.path = new
            else:  # the world goes on with the file before
                stated = recording.stated
                recording = before
                recording.stated = stated
                recording.refused = f"{verb}: exit {done.code}: {done.text.strip()[-300:]}"
    return recording


def _slice(_: Plan, recording: Recording, __: Path, new: Path, ___: list[Sent]) -> Printed:
    recording.whole = False
    return product("slice", recording.path, "-o", new, "--start", SLICE_S[0], "--end", SLICE_S[1])


def _merge(plan: Plan, recording: Recording, folder: Path, new: Path, messages: list[Sent]) -> Printed:
    second = folder / "second.mcap"
    _write(plan, second, _entries(plan, messages, 1))
    offset = f"b={plan.recorder_offset_ns / 1e9:+.9f}"
    return product("merge", f"a={recording.path}", f"b={second}", "-o", new, "--offset", offset)


def _recover(_: Plan, recording: Recording, folder: Path, new: Path, __: list[Sent]) -> Printed:
    if recording.path.is_dir():
        recording.path = sorted(recording.path.glob("*.mcap"))[0]
    data = recording.path.read_bytes()
    cut = folder / "cut.mcap"
    cut.write_bytes(data[: len(data) * 4 // 5])
    recording.whole = False
    return product("recover", cut, "-o", new)


def _deidentify(_: Plan, recording: Recording, folder: Path, new: Path, __: list[Sent]) -> Printed:
    profile = folder / "profile.toml"
    profile.write_text(_PROFILE)
    recording.shift_ns += SHIFT_S * 10**9
    return product("deidentify", recording.path, "-o", new, "--profile", profile, "--shift", SHIFT_S)


def _seal(_: Plan, recording: Recording, folder: Path, new: Path, __: list[Sent]) -> Printed:
    key = folder / "seal.key"
    product("seal", "keys", "new", "-o", key)
    return product("seal", recording.path, "--key", key, "-o", new)


def _foreign(_: Plan, recording: Recording, folder: Path, new: Path, __: list[Sent]) -> Printed:
    """The bag of another program, in which several messages of a topic have one time of receipt."""
    bag = folder / "bag"
    done = product("export", recording.path, "--to", "rosbag2", "-o", bag)
    recording.whole, recording.rounded_ns = False, _ROUNDED_NS
    with new.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "truth")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for path in sorted(bag.glob("*.mcap")):
            with path.open("rb") as source:
                for schema, channel, message in make_reader(source).iter_messages():
                    if schema is None:
                        continue
                    if schema.name not in schemas:
                        schemas[schema.name] = writer.register_schema(schema.name, schema.encoding, schema.data)
                    if channel.topic not in channels:
                        channels[channel.topic] = writer.register_channel(channel.topic, "cdr", schemas[schema.name])
                    rounded_ns = message.log_time // _ROUNDED_NS * _ROUNDED_NS
                    number = channels[channel.topic]
                    writer.add_message(number, rounded_ns, message.data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return done


_VERBS = {
    "foreign": _foreign,
    "slice": _slice,
    "merge": _merge,
    "recover": _recover,
    "deidentify": _deidentify,
    "seal": _seal,
}
