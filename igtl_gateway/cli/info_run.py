"""``igtl-gateway info``: what is in a recording."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.base.errors import BeingRecorded, ConfigError, DamagedRecording, GatewayError, LimitExceeded
from igtl_gateway.base.natural import natural
from igtl_gateway.base.quantities import count_text, duration_text, moment_text, rate_text, size_text
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.base.untrusted.numbers import whole_number
from igtl_gateway.base.untrusted.text import parse_json
from igtl_gateway.cli.common import print_damaged_indexes, utc_text
from igtl_gateway.cli.info_source import STANDARD_INPUT, Recording, recording_of
from igtl_gateway.cli.losses import DIRECTIONS, losses
from igtl_gateway.cli.merge_output import print_merge
from igtl_gateway.cli.next_steps import info_steps, print_next
from igtl_gateway.cli.terminal import aligned, print_json, print_line
from igtl_gateway.config.configuration import Config
from igtl_gateway.gateway.log.changes import SETTING
from igtl_gateway.gateway.log.entry import Kind
from igtl_gateway.gateway.log.ledger import gaps
from igtl_gateway.gateway.log.marks import Mark, joined
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.gateway.stream_units import StreamUnits
from igtl_gateway.record.reports import AGAIN
from igtl_gateway.record.sessionfile import facts, layout
from igtl_gateway.record.sessionfile.added_marks import added_marks, marks_files
from igtl_gateway.record.sessionfile.index import recover_hint
from igtl_gateway.record.sessionfile.reader import PartSummary, SessionFile
from igtl_gateway.replay.content_figures import summary_of
from igtl_gateway.replay.content_summary import ContentSummary, StreamSummary
from igtl_gateway.replay.exchange_summary import ExchangeSummary, ends_text, exchange_count
from igtl_gateway.replay.recorded_clocks import RecordedClocks
from igtl_gateway.replay.recorded_config import peer_units
from igtl_gateway.replay.recorded_marks import marks_of

if TYPE_CHECKING:
    from igtl_gateway.record.sessionfile.salvage import Salvage

_IGTL = frozenset({Kind.IGTL_IN.value, Kind.IGTL_OUT.value})
_ROS = frozenset({Kind.ROS_IN.value, Kind.ROS_OUT.value})
#: Shorter recordings have no rate by the hour, s.
_LEAST_S, _HOUR_S = 10.0, 3600
#: Messages of services and actions that are read for their calls and goals: some seconds.
_MOST_EXCHANGES = 1_000_000
_NOT_YET = "   unknown: the ledger is written when the recording ends"


def run(options: argparse.Namespace) -> int:
    with recording_of(options.file) as recording:
        return _run(options, recording)


def _run(options: argparse.Namespace, recording: Recording) -> int:
    place = recording.place
    try:
        with SessionFile.open(place, incomplete=True) as file:
            begin_ns = whole_number(file.session.get("slice_start_ns")) or 0
            content, why = summary_of(file, begin_ns, full=options.full)
            content.offsets = RecordedClocks.of(file).offsets
            summary = _facts(place, file, content, file.start_ns, file.end_ns) | {"file": str(options.file)}
            summary["bytes"] = file.size
            summary["figures"] = {"entries_read": why is not None, "why": why or ""}
            summary["damaged_indexes"] = file.damaged_indexes()
            summary["skipped"] = [asdict(skipped) for skipped in file.skipped]
            uncounted = 0 if options.full else exchange_count(file)
            is_few = uncounted <= _MOST_EXCHANGES
            summary |= _exchanges(ExchangeSummary.of(file) if is_few else ExchangeSummary())
            summary["uncounted"] = 0 if is_few else uncounted
            if file.parts:
                summary["parts"] = [_part(part) for part in file.parts]
                summary["missing_parts"] = [list(each) for each in file.missing_parts]
            if file.merge:
                summary["merge"] = dict(file.merge.facts)
            if recording.bag:
                summary |= recording.bag
                for stream in summary["streams"]:
                    stream.pop("unit", None)  # of the configuration of the temporary session
    except LimitExceeded:
        raise
    except DamagedRecording as error:
        if options.file.is_dir():
            raise  # it names the part that is damaged
        return _run_damaged(options, place, error)
    if options.json:
        print_json(summary)
    else:
        _print(summary, content.notes, file.start_ns)
        types = [each["stream"] for each in summary["streams"] if each["direction"] in _IGTL]
        problems = bool(summary["problems"])
        print_damaged_indexes(options.file, summary["damaged_indexes"])
        if options.file != STANDARD_INPUT:  # no other verb reads it
            sessions = [part["session"] for part in file.merge.facts["parts"]] if file.merge else [file.session]
            steps = info_steps(
                str(options.file),
                is_foreign=summary["foreign"] and not file.merge,
                is_bag=bool(recording.bag),
                is_empty=not summary["entries"],
                verifies=all(layout.IMPORTED_KEY not in each for each in sessions),
                has_problems=problems,
                types=types,
            )
            if steps:
                print_next(*steps)
    # the retention deletes the first parts, and nothing deletes one between others
    has_gap = any(first for first, _ in summary.get("missing_parts", []))
    bad_marks = bool(summary["added_marks"] and summary["added_marks"]["problem"])
    return 1 if summary["damaged_indexes"] or has_gap or bad_marks else 0


def _run_damaged(options: argparse.Namespace, place: Path, error: DamagedRecording) -> int:
    """The same of whatever can be read: a finding, unless the recording has not ended yet."""
    growing = isinstance(error, BeingRecorded)
    why = str(error).replace(str(place), str(options.file))
    from igtl_gateway.record.sessionfile.salvage import Salvage  # here: few recordings are damaged

    with Salvage.open(place) as file:
        exchanges = ExchangeSummary()
        content = ContentSummary.of(exchanges.passing(file.entries()))
        report = file.report
        summary = _facts(place, file, content, report.start_ns, report.end_ns)
        summary |= {"file": str(options.file), "skipped": [], **_exchanges(exchanges)}
    summary["bytes"] = place.stat().st_size
    summary |= {"being_recorded": True} if growing else {"damaged": {"why": why, **asdict(report)}}
    if options.json:
        print_json(summary)
        return 0 if growing else 1
    _print(summary, content.notes, report.start_ns)
    if growing:
        return 0
    from igtl_gateway.cli.recover_run import print_losses  # here: it needs all of what repairs

    print_line("  DAMAGED")
    print_losses(report)
    is_named = options.file != STANDARD_INPUT
    hint = recover_hint(options.file if is_named else Path("FILE"))
    print_line(f"igtl-gateway info: {why.removesuffix(recover_hint(options.file))}{hint}", error=True)
    return 1


def _facts(
    path: Path, file: SessionFile | Salvage, content: ContentSummary, start_ns: int, end_ns: int
) -> dict[str, Any]:
    noted = [(stamp_ns, note) for stamp_ns, kind, note in content.notes if kind is Kind.EDGE_NOTE]
    logged = marks_of(file, noted, added=False) if isinstance(file, SessionFile) else joined(noted, start_ns, end_ns)
    added, side = _added(path, start_ns, end_ns)
    marks = sorted((*logged, *added), key=lambda mark: mark.time_ns)
    return {
        "file": str(path),
        "bytes": 0,
        "format_version": file.format_version,
        "foreign": file.foreign,
        "start": utc_text(start_ns),
        "duration_s": (end_ns - start_ns) / NS_PER_S,
        "entries": content.entries,
        "streams": _streams(file, content),
        "problems": dict(sorted(content.problems.items())),
        "peers": [
            {"event": note.code, "at": utc_text(stamp_ns), **note.data}
            for stamp_ns, kind, note in content.notes
            if kind is Kind.LINK
        ],
        "clocks": content.clock_summaries(),
        "changes": [
            {"at": utc_text(stamp_ns), "text": note.text, **note.data}
            for stamp_ns, kind, note in content.notes
            if kind is Kind.EDGE_NOTE and note.code == SETTING
        ],
        "marks": [mark.to_dict(start_ns) for mark in marks],
        "added_marks": side,
        "clock_steps": [
            {
                "at": utc_text(step.at_ns),
                "step_s": step.step_ns / NS_PER_S,
                "jump_s": step.jump_ns / NS_PER_S,
                "ahead_s": step.ahead_ns / NS_PER_S,
                "text": str(step),
            }
            for step in content.steps
        ],
        "session": file.session,
        "ledger": file.ledger,
        "gaps": gaps(file.ledger or {}),
        "seal": None if isinstance(file, SessionFile) and not file.is_sealed else _seal(path),
    }


def _exchanges(found: ExchangeSummary) -> dict[str, Any]:
    return {"services": found.services, "actions": found.actions}


def _added(path: Path, start_ns: int, end_ns: int) -> tuple[Sequence[Mark], dict[str, Any] | None]:
    """Return the marks of the side file, and the facts of it; None without one."""
    names = [found.name for found in marks_files(path)]
    if not names:
        return (), None
    try:
        return added_marks(path, start_ns, end_ns), {"files": names, "sealed": False, "problem": ""}
    except GatewayError as error:
        return (), {"files": names, "sealed": False, "problem": str(error)}


def _streams(file: SessionFile | Salvage, content: ContentSummary) -> list[dict[str, Any]]:
    """Return the streams, with the unit of lengths in each if the file has a configuration."""
    found = sorted(content.streams.items(), key=_order)
    config = facts.configuration(file.session)
    try:
        recorded = Config.from_dict(config)
        links = peer_units(recorded, file) if isinstance(file, SessionFile) else {}
        units = StreamUnits(recorded, content.streams, links)
    except ConfigError:
        config = {}
    return [stream.to_dict() | (_unit_facts(units, key, stream.links) if config else {}) for key, stream in found]


def _unit_facts(units: StreamUnits, key: tuple[Kind, str, str], links: set[int]) -> dict[str, Any]:
    """Return the unit of lengths in a stream, and those of the links whose messages have another one."""
    unit, own = units.of(*key), units.of_links(*key)
    found = {link: own.get(link, unit) for link in sorted(links)}
    if len(set(found.values())) == 1:
        return {"unit": found.popitem()[1]}
    other = {str(link): each for link, each in found.items() if each != unit}
    return {"unit": unit} | ({"link_units": other} if other else {})


def _units_in(stream: dict[str, Any]) -> list[str]:
    """Return the units of lengths in a stream."""
    return [stream["unit"], *dict.fromkeys(stream.get("link_units", {}).values())] if "unit" in stream else []


def _units(streams: list[dict[str, Any]], directions: frozenset[str], setting: str) -> str:
    """Return the units of the streams of one side, the most frequent first; those of the configuration without any."""
    counts = Counter(unit for each in streams if each["direction"] in directions for unit in _units_in(each))
    return " and ".join(unit for unit, _ in counts.most_common()) or setting


def _seal(path: Path) -> dict[str, Any] | None:
    """Return what the files state about their seals; a part of a merged session has none."""
    if path.parent.is_file():
        return None
    from igtl_gateway.record.sessionfile.seals import stated_seals  # here: few recordings are sealed

    stated = [stated_seals(file) for file in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])]
    found = [each for each in stated if each]
    if not found:
        return None
    keys = sorted({key for each in found for key in each.keys})
    closed = len(found) == len(stated) and all(each.closed for each in found)
    return {"keys": keys, "seals": sum(each.seals for each in found), "closed": closed}


def _part(part: PartSummary) -> dict[str, Any]:
    return {
        "file": part.path.name,
        "bytes": part.size,
        "entries": part.entries,
        "start": utc_text(part.start_ns),
        "duration_s": (part.end_ns - part.start_ns) / NS_PER_S,
    }


def _order(item: tuple[tuple[Kind, str, str], StreamSummary]) -> tuple[int, list[tuple[int, str]], str]:
    kind, channel, type_name = item[0]
    return list(DIRECTIONS).index(kind), natural(channel), type_name


def _print(summary: dict[str, Any], notes: list[tuple[int, Kind, Note]], start_ns: int) -> None:
    session = summary["session"]
    foreign = "bag of rosbag2" if Path(summary["file"]).is_dir() else "MCAP file of another program"
    kind = foreign if summary["foreign"] else f"session log version {summary['format_version']}"
    if "merge" in summary:
        kind = f"merged session of {count_text(len(summary['merge']['parts']), 'part')}"
    parts = summary.get("parts", [])
    number = f"{count_text(len(parts), 'part')}, " if parts else ""
    print_line(f"{summary['file']}: {kind}, {number}{size_text(summary['bytes'])}")
    if "being_recorded" in summary:
        print_line("  BEING RECORDED: content up to the last flush")
    if summary["entries"]:
        jumped_s = sum(step["jump_s"] for step in summary["clock_steps"])
        jumps = f" ({duration_text(jumped_s * NS_PER_S)} of it jumps of the clock)" if jumped_s else ""
        number = count_text(summary["entries"], "entry", "entries")
        duration = duration_text(summary["duration_s"] * NS_PER_S)
        print_line(f"  start     {summary['start']}, {duration}{jumps}, {number}")
        if summary["duration_s"] >= _LEAST_S and not summary["foreign"]:
            hourly = size_text(summary["bytes"] * _HOUR_S / summary["duration_s"])
            print_line(f"  disk      {hourly} an hour")
        if restores := sum(stream["restores"] for stream in summary["streams"]):
            messages = count_text(restores, "message")
            print_line(f"  state     {messages} of before the slice: counted here, and in no rate and no gap")
    else:
        print_line("  no entries")
    figures = summary.get("figures", {"entries_read": True, "why": ""})
    if not figures["entries_read"]:
        print_line("  figures   of the recorder; its entries are not read: --full reads them")
    elif figures["why"]:
        print_line(f"  figures   of all entries, not of the recorder: {figures['why']}")
    made = session.get("igtl_gateway_version")
    if made:
        print_line(f"  made by   igtl-gateway {made}" + (f" ({session['scenario']})" if "scenario" in session else ""))
    if "synthetic" in session:
        print_line(f"  synthetic {session['synthetic']}")
    if summary["format_version"] == layout.DIGEST_VERSION:
        print_line("  outputs   large ones are digests; for other programs: export --to mcap")
    for key, value in parse_json(session.get(layout.CUSTOM_KEY, "{}"), layout.CUSTOM_KEY).items():
        print_line(f"  {key:<9} {value}")
    missing, streams = summary.get("missing_parts", []), summary["streams"]
    for line in _origin(session, is_folder=bool(parts)):
        print_line(f"  {line}")
    if missing:
        print_line(f"  MISSING   {_missing(missing)}")
    if seal := summary["seal"]:
        end = "" if seal["closed"] else ", the last seal is missing"
        print_line(
            f"  sealed    by key {' '.join(seal['keys'])}, {count_text(seal['seals'], 'seal')}{end}; "
            "not checked: igtl-gateway verify --seal"
        )
    config = facts.configuration(session)
    if config:
        igtl_unit, ros_unit, stamp, base_frame = (
            config.get(key, "unknown") for key in ("igtl_unit", "ros_unit", "stamp", "base_frame")
        )
        igtl_unit, ros_unit = _units(streams, _IGTL, igtl_unit), _units(streams, _ROS, ros_unit)
        print_line(
            f"  units     {igtl_unit} in OpenIGTLink, {ros_unit} in ROS; stamps: {stamp}; base frame {base_frame!r}"
        )
    if "merge" in summary:
        print_merge(summary["merge"])
    if parts:
        print_line("  parts")
        rows: list[Sequence[str]] = [("file", "entries", "size", "start", "duration")]
        for part in parts:
            span = (part["start"], duration_text(part["duration_s"] * NS_PER_S)) if part["entries"] else ("", "")
            rows.append((part["file"], f"{part['entries']:,}", size_text(part["bytes"]), *span))
        print_line(*aligned(rows, indent="    "))
    _print_streams(streams)
    _print_exchanges("services", "calls", "service", summary["services"])
    _print_exchanges("actions", "goals", "action", summary["actions"])
    if uncounted := summary.get("uncounted", 0):
        print_line(
            f"  services  {count_text(uncounted, 'message')} of services and actions: --full counts calls and goals"
        )
    for title, lines in (
        ("links", [_line(stamp, note, start_ns) for stamp, kind, note in notes if kind is Kind.LINK]),
        ("clocks", [line for clock in summary["clocks"] for line in _clock(clock)]),
        ("settings", [f"{change['at']}  {change['text']}" for change in summary["changes"]]),
        ("host's clock", [f"{step['at']}  {step['text']}" for step in summary["clock_steps"]]),
        ("marks", [*map(_mark, summary["marks"]), *_side_lines(summary["added_marks"])]),
        ("triggers", _triggers((summary["ledger"] or {}).get(layout.TRIGGERS_KEY, ()), start_ns)),
        ("problems", [f"{number:>7,}  {code}" for code, number in summary["problems"].items()] or ["   none"]),
        ("first note of each problem", _firsts(notes, start_ns)),
        ("losses", _gaps(notes, start_ns) + _losses(summary)),
        (
            "skipped",
            [f"{each['topic']} ({count_text(each['count'], 'message')}): {each['why']}" for each in summary["skipped"]],
        ),
    ):
        if lines:
            print_line(f"  {title}")
            for line in lines:
                print_line(f"    {line}")


def _losses(summary: dict[str, Any]) -> list[str]:
    return [_NOT_YET] if "being_recorded" in summary else losses(summary["ledger"]) or ["   none"]


def _gaps(notes: list[tuple[int, Kind, Note]], start_ns: int) -> list[str]:
    """Return the times in which the disk took nothing, a line each."""
    found = [(stamp, note.data.get("missing_s")) for stamp, _, note in notes if note.code == AGAIN]
    return [
        f"   gap of {duration_text(missing_s * NS_PER_S)}, until {moment_text(stamp - start_ns)}: the disk took nothing"
        for stamp, missing_s in found
        if isinstance(missing_s, (int, float))
    ]


def _missing(gaps: list[list[int]]) -> str:
    """Return which parts are not there, and what that means for the rest."""
    names = [f"{first}" if first == last else f"{first} to {last}" for first, last in gaps]
    is_one = len(gaps) == 1 and gaps[0][0] == gaps[0][1]
    these, theirs = ("part", "its") if is_one else ("parts", "their")
    text = f"{these} {' and '.join(names)} of the recording: {theirs} entries are not here"
    return (
        text
        if any(first for first, _ in gaps)
        else f"{text}; the prologue of part {gaps[0][1] + 1} has the state before it"
    )


def _origin(session: dict[str, str], *, is_folder: bool) -> list[str]:
    """Return lines about what the file is a part of."""
    lines = []
    if layout.PART_KEY in session and not is_folder:
        before = f", after {session[layout.PREVIOUS_KEY]}" if layout.PREVIOUS_KEY in session else ""
        lines.append(f"part      {session[layout.PART_KEY]} of a split recording{before}")
    if layout.TRIGGER_KEY in session:
        lines.append(f"black box by {session[layout.TRIGGER_KEY]}")
    elif layout.SNAPSHOT_KEY in session:
        lines.append(f"snapshot  of the last {session[layout.SNAPSHOT_KEY]} s before the request")
    if "slice_of" in session:
        start, end = (utc_text(int(session[key])) for key in ("slice_start_ns", "slice_end_ns"))
        lines.append(
            f"slice     of {session['slice_of']}, {start} to {end}, "
            f"streams {_globs(session.get('slice_streams', '')) or 'all'}"
        )
    for key, word in ((layout.INCLUDE_KEY, "only"), (layout.EXCLUDE_KEY, "without")):
        if globs := _globs(session.get(key, "")):
            lines.append(f"recorded  {word} {globs}")
    return lines


def _globs(text: str) -> str:
    return " ".join(parse_json(text, "globs")) if text else ""


def _print_streams(streams: list[dict[str, Any]]) -> None:
    """Print the streams as one table, with a line of titles for each direction."""
    units = {
        side: {unit for stream in streams if (stream["direction"] in _IGTL) is side for unit in _units_in(stream)}
        for side in (True, False)
    }
    rows: list[Sequence[str]] = []
    direction = ""
    for stream in streams:
        if stream["direction"] != direction:
            direction = stream["direction"]
            rows.append((DIRECTIONS[Kind(direction)], "messages", "rate", "size", ""))
        rows.append(_stream_row(stream, shows_unit=len(units[direction in _IGTL]) > 1))
    if rows:
        print_line(*aligned(rows, text=True))


def _print_exchanges(title: str, number: str, name: str, found: list[dict[str, Any]]) -> None:
    """Print a table of services or actions: how many calls or goals, and how they ended."""
    if found:
        rows = [(f"  {each[name]}", f"{each[number]:,}", ends_text(each)) for each in found]
        print_line(*aligned([(title, number, ""), *rows], text=True))


def _stream_row(stream: dict[str, Any], *, shows_unit: bool) -> Sequence[str]:
    """Return the row of a stream: name, messages, rate, size, and in words its gap, type, unit and stamps."""
    unit = ""
    if shows_unit:
        others = (f"{each} (link {link})" for link, each in stream.get("link_units", {}).items())
        unit = f"lengths in {', '.join((stream['unit'], *others))}"
    facts = (
        f"GAP of {duration_text(stream['longest_pause_s'] * NS_PER_S)}" if stream["gap"] else "",
        stream["type"] if "/" in stream["type"] else "",
        unit,
        stream["stamps"],
        f"{stream['restores']:,} before the slice" if stream["restores"] else "",
    )
    return (
        f"  {stream['stream']}",
        f"{stream['messages']:,}",
        rate_text(stream["rate_hz"]) if stream["rate_hz"] else "",
        size_text(stream["bytes"]),
        ", ".join(filter(None, facts)),
    )


def _peer(clock: dict[str, Any]) -> str:
    return f"link {clock['link']} {clock['peer']}".rstrip() if clock["link"] else clock["peer"]


def _clock(clock: dict[str, Any]) -> Iterator[str]:
    yield f"{_peer(clock)} by {clock['stream']}: {clock['text']}"
    if "offset" in clock:
        yield f"{_peer(clock)}: {clock['offset']['text']}"


def _line(stamp_ns: int, note: Note, start_ns: int) -> str:
    return f"{moment_text(stamp_ns - start_ns):>11}  {note.text}"


def _mark(mark: dict[str, Any]) -> str:
    text = ": ".join(filter(None, (mark["label"], mark["text"]))) + (f" ({mark['who']})" if mark["who"] else "")
    open_end = " (open)" if mark["open"] else ""
    end = "" if mark["end_s"] is None else f" to {moment_text(mark['end_s'] * NS_PER_S)}{open_end}"
    return f"{moment_text(mark['at_s'] * NS_PER_S):>11}{end}  {text}" + (" [added]" if mark["added"] else "")


def _triggers(rows: Sequence[dict[str, Any]], start_ns: int) -> list[str]:
    """Return a line for each trigger, in the order of their times: a mark may have come late."""
    return [_trigger(row, start_ns) for row in sorted(rows, key=lambda row: row["at_ns"])]


def _trigger(row: dict[str, Any], start_ns: int) -> str:
    count = f", {row['count']:,} times" if row["count"] > 1 else ""
    missing = f"; INCOMPLETE: {row['missing']}" if row["missing"] else ""
    return f"{moment_text(row['at_ns'] - start_ns):>11}{count}  {row['rule']}: {row['why']}{missing}"


def _side_lines(side: dict[str, Any] | None) -> list[str]:
    if side is None:
        return []
    if side["problem"]:
        return [f"! {side['problem']}"]
    return [f"[added] after the recording was closed: {' '.join(side['files'])}, which no seal covers"]


def _firsts(notes: list[tuple[int, Kind, Note]], start_ns: int) -> list[str]:
    firsts: dict[str, str] = {}
    for stamp_ns, _, note in notes:
        if note.level >= Level.WARN and note.code not in firsts:
            firsts[note.code] = _line(stamp_ns, note, start_ns)
    return list(firsts.values())
