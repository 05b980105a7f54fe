"""The rules for notes: the numbers and words stay that the gateway reads, text and all other facts do not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from igtl_gateway.addon.igtl import BODIES
from igtl_gateway.addon.notes import (
    ASK_CLOCK,
    CLOCK_STEP,
    LISTENED,
    ORDERS,
    PARTNER,
    REFUSED_COMMANDS,
    REFUSED_DEVICE,
    REPORT_CLOCK,
    SETTING,
    SETTINGS,
    TICK,
    UNWRITTEN,
)
from igtl_gateway.addon.reading import Mark, MarkNote, Note
from igtl_gateway.addon.untrusted import whole_number
from igtl_gateway.addons.deidentify.context import Context

#: Codes of inputs; a note with another code becomes ``OTHER``.
CODES = frozenset({
    TICK, LISTENED, ASK_CLOCK, SETTING, CLOCK_STEP, "halted",
    *"link_up link_down peer_profile connect_failed listen_failed accept_failed refused tls_failed idle".split(),
    *"websocket_failed stalled unreachable rate_limited truncated too_large out_of_memory internal_error".split(),
    *"queue_drop queue_full".split(),
    *"no_conversion no_interfaces callback_failed ros_subscribed ros_incompatible_qos ros_lost ros_slow".split(),
    *"ros_hold_overflow ros_unknown_type ros_refused ros_publish_failed ros_receive_failed ros_callback_failed".split(),
    *"ros_held_old ros_type_hash ros_bad_attachment ros_bad_token ros_call_refused".split(),
    *"site_clock site_latency site_lost site_over_budget zenoh_connected zenoh_lost zenoh_left zenoh_no_router".split(),
    *"site_command_late zenoh_not_closed".split(),
    *"video_drop video_changed video_refused video_failed".split(),
    *"record_drop record_failed record_refused record_undefined".split(),
    *"record_thread record_paused record_resumed record_snapshot fault fault_disconnect synthetic".split(),
    *"record_started record_stopped record_stalled record_moves record_waits".split(),
    *"no_source source_came trigger trigger_saved trigger_incomplete".split(),
    *"record_continued record_part_lost record_split_held record_again record_late record_on_time".split(),
    *"record_space_low record_space record_rate".split(),
    *"retention_deleted retention_kept retention_clock retention_failed".split(),
    *REFUSED_COMMANDS, UNWRITTEN,
    *"upload_confirmed upload_waits upload_reached upload_differs stamps_corrected deidentified".split(),
})  # fmt: skip
OTHER = "other"
_ROLES = frozenset({"server", "client"})
_NUMBERS = frozenset(
    {PARTNER, "sent_messages", "received_bytes", "count", "step_ns", "jump_ns", "ahead_ns", "late_ns"}
    | {"dropped_messages"}
)
#: Most characters of label and maker of a mark.
_LONGEST = 64
_LISTS = ("deny_in", "deny_out")


def clean_note(payload: bytes, context: Context) -> bytes:
    """Return the payload of a note without identity."""
    note = Note.of(payload)
    if mark := MarkNote.of(note):
        return _clean_mark(mark, context).note().pack()
    data = _data(note.data, context)
    code = note.code if note.code in CODES else OTHER
    text = code.replace("_", " ")
    context.report.add("note", (note.text != text) + len(note.data.keys() - data.keys()) + (code != note.code))
    stream = context.stream_name(note.stream) if note.stream.partition("/")[0] in ("", *BODIES) else ""
    return Note(note.level, code, text, stream, data).pack()


def clean_mark(mark: Mark, context: Context) -> Mark:
    """Return a mark that was added to the recording, as one in it."""
    new = _clean_mark(MarkNote(mark.label, mark.text, mark.who), context)
    until_ns = None if mark.end_ns is None else context.times.ns(mark.end_ns)
    return replace(
        mark, label=new.label, text=new.text, who=new.who, time_ns=context.times.ns(mark.time_ns), end_ns=until_ns
    )


def _clean_mark(mark: MarkNote, context: Context) -> MarkNote:
    """Return a mark with pseudonyms of label and maker, and the text that the profile leaves of ``mark/LABEL``."""
    label, who = (context.names.name(name)[:_LONGEST] if name else "" for name in (mark.label, mark.who))
    text = context.text(mark.text, f"mark/{mark.label}")
    return MarkNote(label, text if text.isprintable() else "", who, mark.phase, mark.ago_ns)


def _data(data: dict[str, Any], context: Context) -> dict[str, Any]:
    kept: dict[str, Any] = {}
    for key, value in data.items():
        if key in ("peer", "local", "asked") and isinstance(value, str):
            kept[key] = context.names.address(value, "peer" if key == "peer" else "host")
            context.report.add("address")
        elif key == REFUSED_DEVICE and isinstance(value, str):
            kept[key] = context.names.name(value)
        elif (key == "role" and value in _ROLES) or (key in _NUMBERS and type(value) in (int, float)):
            kept[key] = value
        elif (key == "dropped" and type(value) is int) or (key == REPORT_CLOCK and value is True):
            kept[key] = value
        elif key == ORDERS and isinstance(value, dict):
            kept[key] = {number: _clean_order(order) for number, order in value.items() if _is_number(number)}
        elif key == SETTINGS and isinstance(value, dict):
            kept[key] = _settings(value, context)
    return kept


def _clean_order(order: Any) -> list[str]:
    """Return code and text of a command that was not written, without the values in its text."""
    first = order[0] if isinstance(order, list) and order else None
    code = first if isinstance(first, str) and first in REFUSED_COMMANDS else OTHER
    return [code, code.replace("_", " ")]


def _settings(settings: dict[str, Any], context: Context) -> dict[str, Any]:
    """Return the changed settings: types and kinds that the gateway knows, numbers and truth values."""
    kept: dict[str, Any] = {}
    for key, value in settings.items():
        if key in _LISTS and isinstance(value, list):
            kept[key] = known_types(value)
        elif key == "kinds" and isinstance(value, list):
            kept[key] = known_kinds(value, context)
        elif key in ("max_age_s", "active") and type(value) in (int, float, bool):
            kept[key] = value
    return kept


def known_types(names: Any) -> list[str]:
    """Return the types of OpenIGTLink among names and globs."""
    return [name for name in names if isinstance(name, str) and (name in BODIES or not name.strip("*?"))]


def known_kinds(names: Any, context: Context) -> list[str]:
    """Return the kinds of the conversion table among names, with their sign."""
    return [name for name in names if isinstance(name, str) and name.lstrip("+") in context.names.words]


def _is_number(text: object) -> bool:
    return whole_number(text) is not None
