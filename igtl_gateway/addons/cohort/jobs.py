"""The verbs of a cohort: what each makes of one open session, as rows of tables."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import (
    NS_PER_MS,
    NS_PER_S,
    BeingRecorded,
    ConfigError,
    DamagedRecording,
    GatewayError,
    UnsupportedRecording,
    streams_expected,
)
from igtl_gateway.addon.checking import (
    IMPORTED,
    RULES,
    ContentSummary,
    DoctorReport,
    Segment,
    Verification,
    VerifyReport,
    ledger_gaps,
    observe_entries,
    recorded_by,
    segments_of,
    verify_segment_of,
    verify_session,
)
from igtl_gateway.addon.processes import part_of
from igtl_gateway.addon.reading import Kind, SessionFile, layout, marks_of, named
from igtl_gateway.addon.untrusted import cpu_time, files, limits
from igtl_gateway.addons.cohort.ends import (
    BROKEN,
    EXPORT,
    FAILED,
    GROWING,
    MEMORY,
    NOTHING,
    OK,
    UNCHANGED,
    UNREACHABLE,
    UNREADABLE,
    UNSUPPORTED,
)
from igtl_gateway.addons.cohort.objects import ObjectFile, Unreachable, is_url

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.columns import Row
    from igtl_gateway.addons.review import EndReview, Review

Rows = dict[str, list["Row"]]

#: Settings of `verify`, of tasks that are not the whole file: most segments, to plan them; or one of them.
SEGMENTS, SEGMENT = "segments", "segment"
#: Rows of one table that one file may have, and characters of one text.
MOST_ROWS = 20_000
_LONGEST = 2_000
#: Bytes that are hashed at a time.
_HASHED = 1 << 20
_DAMAGED = RULES[0]
#: What a task reports whose program reaches its bound.
TOO_LARGE = "needs more memory than a worker may have (--memory-mib)"


@dataclass(frozen=True, slots=True)
class CohortVerb:
    """A verb.

    Attributes:
        help: one line.
        work: makes the rows of an open session; the settings are those of the run.
        tables: the tables that it fills.
        broken: makes the rows of a file that cannot be read, of the reason.
    """

    help: str
    work: Callable[[SessionFile, Mapping[str, Any]], Rows]
    tables: tuple[str, ...]
    broken: Callable[[str], Rows] = lambda reason: {}


def run_job(job: Mapping[str, Any]) -> dict[str, Any]:
    """Do the job of one file.  Never raises for what is in the file.

    Args:
        job: ``name`` of the file, ``size``, ``e_tag`` of an object, ``verb``, ``settings``,
            ``limits`` (words of ``--limit``), and ``content``, the SHA-256 of the file at the last time, ``""`` if
            unknown.

    Returns:
        ``status`` with ``error``; ``content``; ``rows`` by table; ``requests`` and ``bytes_read`` of an object store.
    """
    verb = VERBS[job["verb"]]
    reply: dict[str, Any] = {"content": "", "requests": 0, "bytes_read": 0, "error": "", "rows": {}}
    status, error = OK, ""
    try:
        with limits.limits_in_force(limits.parse_limits(list(job["limits"]))), cpu_time.bounded():
            if not is_url(job["name"]) and SEGMENT not in job["settings"]:
                reply["content"] = content_of(Path(job["name"]))
                if job["content"] and reply["content"] == job["content"]:
                    return reply | {"status": UNCHANGED}
            with _opened(job, reply) as file:
                rows = verb.work(file, job["settings"])
                for table, found in rows.items():
                    if len(found) > MOST_ROWS:
                        error = f"found {len(found)} {table}, kept the first {MOST_ROWS}"
                        del found[MOST_ROWS:]
                reply["rows"] = rows
    except MemoryError:
        status, error = MEMORY, TOO_LARGE
    except BeingRecorded as problem:
        status, error = GROWING, str(problem)
    except DamagedRecording as problem:
        status, error = BROKEN, str(problem)
        reply["rows"] = verb.broken(error)
    except UnsupportedRecording as problem:
        status, error = UNSUPPORTED, str(problem)
    except Unreachable as problem:
        status, error = UNREACHABLE, str(problem)
    except GatewayError as problem:
        is_absent = type(problem) in (GatewayError, ConfigError)  # the session has no plan, no such stream …
        status, error = NOTHING if is_absent else FAILED, str(problem)
    except OSError as problem:  # of a disk or a network
        status, error = UNREACHABLE, str(problem)
    except Exception as problem:  # one file must not end the cohort; the type leads to the defect
        if isinstance(problem, RuntimeError) and "start new thread" in str(problem):  # no memory for its stack
            status, error = MEMORY, TOO_LARGE
        else:
            status, error = FAILED, f"{type(problem).__name__}: {problem}"
    return reply | {"status": status, "error": error[:_LONGEST]}


def content_of(path: Path) -> str:
    """Return the SHA-256 of a local file.  Raises UnsupportedRecording, LimitExceeded, OSError."""
    found, deadline = hashlib.sha256(), files.deadline_of(path)
    with files.open_file(path) as stream:
        while block := stream.read(_HASHED):
            deadline.check(str(path))
            found.update(block)
    return f"sha256:{found.hexdigest()}"


@contextmanager
def _opened(job: Mapping[str, Any], reply: dict[str, Any]) -> Iterator[SessionFile]:
    name = job["name"]
    if not is_url(name):
        with SessionFile.open(Path(name)) as file:
            yield file
        return
    raw = ObjectFile(name, int(job["size"]), job["e_tag"])
    try:
        with named(Path(name), name), io.BufferedReader(raw, raw.block) as stream:
            yield SessionFile(Path(name), stream)
    finally:
        reply |= {"requests": raw.requests, "bytes_read": raw.bytes_read}


# -- info: of the index --------------------------------------------------------------------------


def _info(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    session, ledger = file.session, file.ledger
    streams = []
    for channel in file.channels:
        if channel.kind in layout.NOTE_KINDS or not channel.count:
            continue
        first, last = file.span(channel)
        span_ns = last - first
        streams.append(
            {
                "direction": channel.kind.value,
                "stream": channel.stream or channel.topic,
                "topic": channel.topic,
                "type": channel.entry_type,
                "messages": channel.count,
                "first": first,
                "last": last,
                "rate_hz": (channel.count - 1) * NS_PER_S / span_ns if span_ns >= NS_PER_MS else None,
            }
        )
    recording = {
        "start": file.start_ns if file.entry_count else None,
        "duration_s": (file.end_ns - file.start_ns) / NS_PER_S,
        "entries": file.entry_count,
        "streams": len(streams),
        "format_version": file.format_version,
        "is_foreign": file.foreign,
        "recorded_by": session.get("igtl_gateway_version"),
        "scenario": session.get("scenario"),
        "imported": session.get(IMPORTED),
        "part": int(session[layout.PART_KEY]) if layout.PART_KEY in session else None,
        "links": None if ledger is None else sum(name != "0" for name in ledger.get("links", {})),
        "notes": sum(channel.count for channel in file.channels if channel.kind in layout.NOTE_KINDS),
        "lost": None if ledger is None else len(ledger_gaps(ledger)),
        "has_ledger": ledger is not None,
        "skipped": len(file.skipped),
    }
    return {"recordings": [recording], "streams": streams}


# -- lint: findings and latencies of all entries ------------------------------------------------------------------


def _lint(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    content = ContentSummary()
    report = DoctorReport.of(observe_entries(file, None, content.add))
    findings = [
        {
            "rule": each.rule.id,
            "severity": each.rule.severity.value,
            "title": each.rule.title,
            "place": str(each.match.where),
            "text": str(each.match.text)[:_LONGEST],
        }
        for each in report.findings
    ]
    return {"findings": findings, "latencies": list(_latencies(content)), "marks": list(_marks(file, content))}


def _marks(file: SessionFile, content: ContentSummary) -> Iterator[Row]:
    notes = [(stamp_ns, note) for stamp_ns, kind, note in content.notes if kind is Kind.EDGE_NOTE]
    for mark in marks_of(file, notes):
        yield {
            "label": mark.label,
            "text": mark.text,
            "who": mark.who,
            "time": mark.time_ns,
            "end_time": mark.end_ns,
            "is_open": mark.is_open,
        }


def _latencies(content: ContentSummary) -> Iterator[Row]:
    links = [name for streams in content.clocks.values() for name in streams]
    medians = {key[1]: stream.age_ms for key, stream in content.streams.items() if stream.kind.is_input}
    for link, streams in sorted(content.clocks.items()):
        for name, timing in sorted(streams.items()):
            peer = content.addresses.get(link, "ROS" if link == 0 else "")
            ages = medians.get(name) if links.count(name) == 1 else None  # ages are of all links of a stream
            known = timing.stamped > 0
            yield {
                "link": link,
                "peer": peer,
                "host": peer.rpartition(":")[0] or peer,
                "stream": name,
                "messages": timing.messages,
                "unstamped": timing.unset,
                "median_ms": ages[0] if ages else None,
                "least_ms": timing.least_ns / NS_PER_MS if known else None,
                "jitter_ms": timing.jitter_ns / NS_PER_MS if known else None,
                "spread_ms": (timing.most_ns - timing.least_ns) / NS_PER_MS if known else None,
                "drift_ppm": timing.drift_ppm,
                "future": timing.future,
                "backwards": timing.backwards,
            }


def _damaged(reason: str) -> Rows:
    rule = _DAMAGED
    finding = {"rule": rule.id, "severity": rule.severity.value, "title": rule.title, "place": "file"}
    return {"findings": [finding | {"text": reason[:_LONGEST]}]}


# -- verify, review, sync -----------------------------------------------------------------------------------------


def _verify(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    if most := settings.get(SEGMENTS):
        plan = {"segments": [each.to_dict() for each in segments_of(file, most)], "entries": file.entry_count}
        return {SEGMENTS: [plan | {"recorded_by": recorded_by(file)}]}
    if segment := settings.get(SEGMENT):
        result = verify_segment_of(file, Segment.from_dict(segment))
        return {SEGMENT: [result.to_dict()]} if result else {}
    found = verify_session(file)
    return {"verifications": [verification_row(found, found.recorded_by)]}


def verification_row(found: Verification | VerifyReport, recorder: str) -> Row:
    """Return the row of the result of a file, which the version ``recorder`` has recorded."""
    first = next(iter(found.firsts.values()), None)
    names = ("good", "inputs", "outputs", "equal", "differing", "lost", "missing", "orphans", "late")
    row = {name: getattr(found, name) for name in names} | {"recorded_by": recorder}
    return row | {"first_difference": None if first is None else str(first)[:_LONGEST]}


def _review(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    from igtl_gateway.addons.review import Thresholds  # here: the other verbs work without this add-on
    from igtl_gateway.addons.review.choices import ReviewSelection
    from igtl_gateway.addons.review.recorded import review_session

    review = review_session(file, ReviewSelection(settings["plan"], settings["cloud"], settings["tool"]), Thresholds())
    moved = {each.number: max(each.moved_mm) if each.moved_mm else None for each in review.changes if each.after}
    stitches = list(_stitches(review, moved))
    noise = sorted(
        each[f"{end}_noise_mm"]
        for each in stitches
        if each["is_last"]
        for end in ("entry", "exit")
        if each[f"{end}_noise_mm"] is not None
    )
    summary = {
        "plans": len(review.plans),
        "stitches": len(review.last.stitches),
        "wrong_first": len(review.first.wrong),
        "wrong_last": len(review.last.wrong),
        "corrected": sum(each.moved_mm is not None for each in review.changes),
        "noise_mm": noise[len(noise) // 2] if noise else None,
        "cloud": review.cloud.topic,
        "clouds": review.cloud.clouds,
        "tool": review.tool,
    }
    return {"reviews": [summary], "stitches": stitches}


def _stitches(review: Review, moved: Mapping[int, float | None]) -> Iterator[Row]:
    for number, plan in enumerate(review.plans, 1):
        for stitch in plan.stitches:
            last = plan is review.last
            yield {
                "plan": number,
                "is_first": plan is review.first,
                "is_last": last,
                "topic": plan.topic,
                "time": plan.stamp_ns,
                "number": stitch.number,
                "label": stitch.label,
                "level": stitch.level.value,
                "reasons": "; ".join(stitch.reasons)[:_LONGEST],
                "corrected": stitch.number in moved if last else None,
                "moved_mm": moved.get(stitch.number) if last else None,
                "bite_length_mm": stitch.bite_length_mm,
                "bite_depth_mm": stitch.bite_depth_mm,
                "driven_depth_mm": stitch.driven_depth_mm,
                **_end("entry", stitch.entry),
                **_end("exit", stitch.exit),
            }


def _end(name: str, end: EndReview) -> Row:
    columns = ("distance_mm", "error_mm", "noise_mm", "reading_mm", "density_mm2", "missing")
    executed = end.executed.distance_mm if end.executed else None
    return {f"{name}_{column}": getattr(end, column) for column in columns} | {f"{name}_executed_mm": executed}


def _sync(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    from igtl_gateway.addon.reading import of_session
    from igtl_gateway.addons.sync.lag import measure_lag, measure_together
    from igtl_gateway.addons.sync.lags import movement, movements, too_few

    recording = of_session(file)
    names: Sequence[str] = settings["streams"]
    further: Sequence[Sequence[str]] = settings["pairs"]
    absent = [name for name in (*names, *(name for pair in further for name in pair)) if name not in recording]
    if absent:
        expected = f"by --stream or --pair {streams_expected(absent[:1], recording, file.path)}"
        raise ConfigError(f"{file.path}: found no stream {absent[0]!r}, {expected}")
    signals, unreadable = ([movement(recording[name]) for name in names], {}) if names else movements([recording])
    if len(signals) < 2:
        raise too_few(signals, unreadable, file.path)
    fixed, *others = signals
    pairs = [(movement(recording[one]), movement(recording[other])) for one, other in further]
    rows: list[Row] = []
    for signal in others:
        lag = (
            measure_together([(fixed, signal), *pairs], max_lag_s=settings["max_lag_s"])
            if pairs
            else measure_lag(fixed, signal, max_lag_s=settings["max_lag_s"])
        )
        rows.append(
            {
                "fixed": fixed.name,
                "stream": signal.name,
                "verdict": lag.verdict.name.lower(),
                "has_lag": lag.verdict.has_lag,
                **{
                    f"{name}_ms": _ms(getattr(lag, f"{name}_s"), lag.verdict.has_lag) for name in ("lag", "low", "high")
                },
                "r2": lag.r2,
                "skew_ppm": lag.skew_ppm if lag.has_skew else None,
                "samples": lag.samples,
                "common_s": lag.common_s,
                "reason": lag.verdict.value,
            }
        )
    for key, why in unreadable.items():
        row: Row = {"fixed": fixed.name, "stream": key, "verdict": UNREADABLE, "has_lag": False}
        rows.append(row | {"reason": why[:_LONGEST]})
    return {"lags": rows}


def _ms(seconds: float, known: bool) -> float | None:
    return seconds * 1e3 if known and math.isfinite(seconds) else None


# -- export: the part of a data set, which the add-on `lerobot` makes ----------------------------------------------


def _export(file: SessionFile, settings: Mapping[str, Any]) -> Rows:
    return {EXPORT: [part_of("lerobot", "parts:run_job")(settings["job"])]}


#: Verb → what it does.
VERBS: Mapping[str, CohortVerb] = {
    "info": CohortVerb("index: streams, rates, links", _info, ("recordings", "streams")),
    "lint": CohortVerb(
        "the rules of doctor; clocks of peers; marks", _lint, ("findings", "latencies", "marks"), _damaged
    ),
    "verify": CohortVerb("whether outputs follow from inputs", _verify, ("verifications",)),
    "review": CohortVerb("each stitch of each plan", _review, ("reviews", "stitches")),
    "sync": CohortVerb("lags between moving streams", _sync, ("lags",)),
    EXPORT: CohortVerb("a training set for LeRobot", _export, ()),
}
