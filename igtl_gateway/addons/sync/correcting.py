"""A session with corrected source stamps of some streams, as a new file that verifies."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from igtl_gateway.addon import GatewayError, UnsupportedRecording, __version__
from igtl_gateway.addon.checking import IMPORTED, verify_recording
from igtl_gateway.addon.notes import CORRECTIONS, StampCorrection
from igtl_gateway.addon.reading import Qos, RecordedStamps, SessionFile, layout
from igtl_gateway.addon.writing import SessionWriter, written
from igtl_gateway.addons.sync.correction import corrected


def write_corrected(
    path: Path,
    out: Path,
    corrections: Mapping[tuple[str, str], StampCorrection],
    *,
    check: Callable[[Path], None],
    overwrite: bool = False,
) -> bool:
    """Write the session with the corrections, and check it; return whether it was verified: an import has no outputs.

    Args:
        path: the session.
        out: the file to write.
        corrections: channel and type of the entries of a stream → what is subtracted from its stamps.
        check: called with the written file before it gets its name; what it raises leaves no file.
        overwrite: replace an existing file.

    Raises:
        UnsupportedRecording: the file is of another program.
        GatewayError: the outputs of the gateway depend on these stamps, or the file cannot be written.
    """
    with written(out, overwrite=overwrite) as place:
        with SessionFile.open(path) as file:
            if file.foreign:
                raise UnsupportedRecording(f"{path}: found an MCAP file of another program, expected a session")
            qos = {(channel.topic, channel.type): channel.qos for channel in file.channels}

            def qos_of(topic: str, ros_type: str) -> Qos | None:
                return qos.get((topic, ros_type))

            known = together(RecordedStamps(file).corrections, corrections)
            stated = json.dumps([each.facts() for each in known.values()], sort_keys=True)
            facts = {**file.session, "corrected_by": __version__, CORRECTIONS: stated}
            writer = SessionWriter(place, facts, qos_of=qos_of, definition_of=file.definition_of, compression="zstd")
            for each in file.beside():
                writer.add_beside(each)
            for entry in corrected(file.entries(), corrections):
                writer.write(entry)
            writer.close({**(file.ledger or {}), **layout.declared_losses(file.ledger)})
        has_outputs = IMPORTED not in facts
        if has_outputs and not verify_recording(place).good:
            names = ", ".join(each.stream for each in corrections.values())
            raise GatewayError(f"{names}: found outputs that depend on the source stamps, expected none")
        check(place)
        return has_outputs


def together(
    before: Mapping[tuple[str, str], StampCorrection], new: Mapping[tuple[str, str], StampCorrection]
) -> dict[tuple[str, str], StampCorrection]:
    """Return the corrections of a session with new ones: of a stream that has one, the sum.

    Raises:
        GatewayError: there is no sum: one has a skew, or is of another frame.
    """
    found = dict(before)
    for (channel, type_name), each in new.items():
        old = found.pop((channel, type_name), None) or found.pop((channel, ""), None)
        if old is not None and (old.frame != each.frame or ((old.skew_ppm or each.skew_ppm) and old.is_stamped)):
            raise GatewayError(
                f"{each.stream}: found it corrected already ({old.text()}), expected the recording before that"
            )
        found[channel, type_name] = each if old is None else _sum(old, each)
    return found


def _sum(old: StampCorrection, new: StampCorrection) -> StampCorrection:
    lags = {name: getattr(new, name) + old.lag_ns for name in ("lag_ns", "low_ns", "high_ns")}
    return replace(new, **lags, is_stamped=old.is_stamped)
