"""Export to MCAP: the session as one file, with all bytes of its large outputs, their digests, or none of them.

The file is a session, which verifies.  With all bytes, Foxglove, rosbag2 and rerun read all topics of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.addon import UnsupportedRecording
from igtl_gateway.addon.reading import Entry, Qos, SessionFile, layout
from igtl_gateway.addon.writing import LargeOutputs, Outputs, SessionWriter, written
from igtl_gateway.addons.exchange.account import ExportAccount
from igtl_gateway.addons.exchange.selection import IGTL_KINDS, ROS_KINDS, Recording, matches_stream

_MESSAGES = frozenset({*IGTL_KINDS, *ROS_KINDS})


def export_mcap(recording: Recording, out: Path, globs: Sequence[str], outputs: Outputs = "full") -> ExportAccount:
    """Write the file ``out``, which must not exist.  Raises UnsupportedRecording, RecordingError, OSError."""
    file = getattr(recording, "itself", recording)
    if not isinstance(file, SessionFile) or file.foreign:
        raise UnsupportedRecording("found a recording of another program, expected a session of igtl-gateway")
    account, large = ExportAccount(files=1), LargeOutputs(outputs)
    qos = {(channel.topic, channel.type): channel.qos for channel in file.channels}

    def qos_of(topic: str, ros_type: str) -> Qos | None:
        return qos.get((topic, ros_type))

    # the parts of a split recording become one
    own = (layout.PART_KEY, layout.PREVIOUS_KEY) if file.parts else ()
    facts = {key: value for key, value in file.session.items() if key not in own}
    with written(out) as place:
        writer = SessionWriter(
            place, facts, qos_of=qos_of, definition_of=file.definition_of, compression="zstd",
            prologue=file.prologue(), outputs=large,
        )  # fmt: skip
        for each in file.beside():
            writer.add_beside(each)
        left_out: Counter[str] = Counter()
        for entry in file.entries():
            if entry.kind in _MESSAGES:
                if not matches_stream(entry.channel, entry.kind, globs, entry.links):
                    left_out[entry.channel] += 1
                    large.lacks_inputs = large.lacks_inputs or entry.kind.is_input
                    continue
                _count(account, entry, large, writer)
            else:
                writer.write(entry)
        writer.close(_ledger(file.ledger, left_out + large.left_out))
        if not any(row.taken for row in account.rows):
            place.unlink()
    return account


def _count(account: ExportAccount, entry: Entry, large: LargeOutputs, writer: SessionWriter) -> None:
    """Write a message, and count it."""
    row, before = account.row(entry), large.left_out[entry.channel]
    writer.write(entry)
    if large.left_out[entry.channel] > before:
        row.leave_out("computed where it is needed: --outputs none")
    else:
        row.taken += 1


def _ledger(recorded: dict[str, Any] | None, left_out: Counter[str]) -> dict[str, Any]:
    """The ledger of the recording, with the entries that are not in the new file."""
    ledger: dict[str, Any] = {layout.CUT_OFF_KEY: True} if recorded is None else dict(recorded)
    if left_out:
        recorder = dict(ledger.get("recorder", {}))
        recorder["left_out"] = dict(Counter(recorder.get("left_out", {})) + left_out)
        recorder["left_out_entries"] = recorder.get("left_out_entries", 0) + left_out.total()
        ledger["recorder"] = recorder
    return ledger
