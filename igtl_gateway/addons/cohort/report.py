"""The report of a cohort: one page without links to anything, made of questions to the tables.

A section is there if the tables have something for it; the end names the verbs that would add more.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import __version__
from igtl_gateway.addon.terminal import count_text, seconds_text, size_text
from igtl_gateway.addons.cohort.charts import STYLE, bars, shares, table, text
from igtl_gateway.addons.cohort.ends import NOTHING, OK, VERB_NAMES

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.query import Questions

#: Rows of a list; the tables have all.
_MOST = 40
#: Upper bounds of the classes of depth noise, mm.
_NOISE_MM = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0)
#: Ages from here on are of another clock: a day, ms.
_OTHER_CLOCK_MS = 86_400_000.0
#: Times below this are shown as less than a microsecond, ms.
_LEAST_MS = 0.001

_STYLE = """
:root { color-scheme: light dark; --back: #fff; --ink: #17202b; --soft: #566373; --rule: #d5dae0; --bar: #6fa8bd;
  --marked: #c2410c; }
@media (prefers-color-scheme: dark) {
  :root { --back: #10151b; --ink: #e8edf2; --soft: #a7b4c1; --rule: #2f3944; --bar: #3d7d94; --marked: #f08a4b; }
}
body { font: 15px/1.5 system-ui, "Segoe UI", "Noto Sans", "DejaVu Sans", sans-serif; max-width: 56rem;
  margin: 2rem auto; padding: 0 16px; color: var(--ink); background: var(--back); }
h1 { font-size: 24px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 2.4rem 0 .8rem; padding-bottom: 4px; border-bottom: 1px solid var(--rule); }
.soft { color: var(--soft); } .key { color: var(--marked); }
"""


def page(questions: Questions, folder: str) -> str:
    """Return the page (HTML)."""
    sections = [_ends(questions), _without_result(questions), _differences(questions), _findings(questions)]
    sections += [_latencies(questions), _stitches(questions), _lags(questions), _more(questions)]
    title = f"Cohort {text(folder)}"
    return (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{_STYLE}{STYLE}</style></head>"
        f'<body><h1>{title}</h1><p class="soft">Made by igtl-gateway {text(__version__)}. '
        f"Method of each verb: docs/how-to/cohort.md.</p>"
        f"{''.join(sections)}</body></html>\n"
    )


def _section(title: str, *parts: str) -> str:
    return f"<h2>{text(title)}</h2>{''.join(parts)}"


def _paragraph(line: str) -> str:
    return f"<p>{text(line, 1000)}</p>"


def _order(name: object) -> tuple[str, str]:
    """Return a sort key of a name: 9 is before 10, and small letters are beside large ones."""
    name = str(name)
    return re.sub("[0-9]+", lambda digits: digits[0].zfill(20), name.casefold()), name


def _of(verb: str) -> int:
    """Return the place of a verb."""
    return VERB_NAMES.index(verb) if verb in VERB_NAMES else len(VERB_NAMES)


def _ends(questions: Questions) -> str:
    found = questions.rows(
        "SELECT verb, status, count(*) AS files, sum(bytes) AS bytes, sum(seconds) AS seconds FROM tasks "
        "GROUP BY verb, status ORDER BY files DESC, status"
    )
    found.sort(key=lambda row: _of(row["verb"]))
    [total] = questions.rows(
        "SELECT count(*) AS files, coalesce(sum(duration_s), 0) AS seconds, sum(entries) AS entries FROM sessions"
    )
    known = ""
    if total["entries"]:
        known = f", {seconds_text(total['seconds'])} of recordings, {count_text(total['entries'], 'entry', 'entries')}"
    heads = ("verb", "end", "files", "size", "time of work")
    rows = []
    for row in found:
        end, worked = str(row["status"]).replace("_", " "), row["seconds"] or 0.0
        needed = seconds_text(worked) if worked >= 1 else "less than 1 s"
        rows.append((row["verb"], end, f"{row['files']:,}", size_text(row["bytes"] or 0), needed))
    return _section(
        "Sessions", _paragraph(f"{count_text(total['files'], 'file')}{known}."), table(heads, rows, heads[2:])
    )


def _stitches(questions: Questions) -> str:
    """Of the stitches of the first plans: which were corrected later, by the noise where they were planned."""
    [total] = questions.rows(
        "SELECT count(*) AS sessions, sum(plans) AS plans, sum(stitches) AS stitches, sum(corrected) AS corrected, "
        "sum(wrong_first) AS wrong_first, sum(wrong_last) AS wrong_last FROM reviews"
    )
    if not total["stitches"]:
        return ""
    planned = questions.rows(
        "SELECT greatest(first.entry_noise_mm, first.exit_noise_mm) AS noise_mm, coalesce(last.corrected, false) "
        "AS corrected FROM stitches first LEFT JOIN stitches last ON first.task = last.task "
        "AND first.number = last.number AND last.is_last WHERE first.is_first"
    )
    classes = []
    bounds = (0.0, *_NOISE_MM, float("inf"))
    for low, high in itertools.pairwise(bounds):
        inside = [row for row in planned if row["noise_mm"] is not None and low <= row["noise_mm"] < high]
        name = f"≥ {low:g}" if high == float("inf") else f"{low:g}–{high:g}"
        classes.append((name, len(inside), sum(row["corrected"] for row in inside)))
    chart = shares(classes, "depth noise where the stitch was planned, mm (the larger of both ends)")
    unknown = sum(row["noise_mm"] is None for row in planned)
    first = questions.rows(
        "SELECT level, count(*) FILTER (is_first) AS first, count(*) FILTER (is_last) AS last "
        "FROM stitches GROUP BY level ORDER BY level"
    )
    heads = ("level", "first versions", "last versions")
    corrected = "was" if total["corrected"] == 1 else "were"
    return _section(
        "Stitches that had to be corrected",
        _paragraph(
            f"{count_text(total['plans'], 'version')} of plans in {count_text(total['sessions'], 'session')}; of "
            f"{count_text(total['stitches'], 'stitch', 'stitches')} of the last versions, {total['corrected']:,} "
            f"{corrected} corrected after the "
            f"first version. Wrong: {total['wrong_first']:,} in the first, {total['wrong_last']:,} in the last."
        ),
        "<p>Stitches of the first versions by depth noise, and "
        '<span class="key">those that were corrected later</span>, with their share.</p>'
        if chart
        else "",
        chart,
        _paragraph(f"{count_text(unknown, 'stitch', 'stitches')} without a known noise.") if unknown else "",
        table(heads, [[row["level"], f"{row['first']:,}", f"{row['last']:,}"] for row in first], heads[1:]),
    )


def _latencies(questions: Questions) -> str:
    found = questions.rows(
        "SELECT host, count(DISTINCT file) AS files, sum(messages) AS messages, median(least_ms) AS least_ms, "
        "median(jitter_ms) AS jitter_ms, quantile_cont(spread_ms, 0.95) AS spread_ms FROM latencies "
        f"WHERE least_ms IS NOT NULL GROUP BY host ORDER BY spread_ms DESC, host LIMIT {_MOST}"
    )
    if not found:
        return ""
    found.sort(key=lambda row: (-round(row["spread_ms"], 3), _order(row["host"])))
    hosts = [row["host"] or "unknown" for row in found]
    drawn = [
        (host, round(row["spread_ms"], 3), f"{_milliseconds(row['spread_ms'])} ms")
        for host, row in zip(hosts, found, strict=True)
    ]
    cells = [
        [host, f"{row['files']:,}", f"{row['messages']:,}", *(_milliseconds(row[key]) for key in _LATENCIES)]
        for host, row in zip(hosts, found, strict=True)
    ]
    heads = ("peer", "files", "messages", "least age, ms", "jitter, ms", "spread p95, ms")
    chart = bars(drawn)
    return _section(
        "Latency by peer",
        _paragraph(
            "Age of the messages when they arrive, by the stamps of the sender. The least age contains the offset "
            "of the clocks; the spread (largest less least age) does not."
            + " Bars: 95th percentile of the spread."
            * bool(chart)
        ),
        chart,
        table(heads, cells, heads[1:], heads[:1]),
    )


_LATENCIES = ("least_ms", "jitter_ms", "spread_ms")


def _milliseconds(value: float | None) -> str | None:
    """Return a time for a person; one of another clock is left out."""
    if value is None:
        return None
    if abs(value) >= _OTHER_CLOCK_MS:
        return "another clock"
    if abs(value) < _LEAST_MS / 2:
        return "0" if not value else "< 0.001"
    return f"{value:,.3f}" if abs(value) < 10 else f"{value:,.1f}"


def _findings(questions: Questions) -> str:
    found = questions.rows(
        "SELECT rule, any_value(title) AS title, count(DISTINCT file) AS files, count(*) AS cases FROM findings "
        f"GROUP BY rule ORDER BY files DESC, rule LIMIT {_MOST}"
    )
    [done] = questions.rows(f"SELECT count(*) AS files FROM tasks WHERE verb = 'lint' AND status = '{OK}'")
    if not found and not done["files"]:
        return ""
    title = "What lint finds most"
    if not found:
        return _section(title, _paragraph(f"Nothing, in {count_text(done['files'], 'file')}."))
    drawn = [(f"{row['rule']} {row['title']}", row["files"], count_text(row["files"], "file")) for row in found]
    heads = ("rule", "finding", "files", "cases")
    rows = [(row["rule"], row["title"], f"{row['files']:,}", f"{row['cases']:,}") for row in found]
    return _section(title, bars(drawn), table(heads, rows, heads[2:], heads[1:2]))


def _differences(questions: Questions) -> str:
    title = "Sessions that do not verify"
    [total] = questions.rows("SELECT count(*) AS files, count(*) FILTER (NOT good) AS bad FROM verifications")
    if not total["files"]:
        return ""
    if not total["bad"]:
        every = count_text(total["files"], "verified session")
        return _section(title, _paragraph(f"None: outputs follow from inputs in {every}."))
    found = questions.rows(
        "SELECT file, differing, outputs, first_difference FROM verifications WHERE NOT good "
        f"ORDER BY differing DESC, file LIMIT {_MOST}"
    )
    found.sort(key=lambda row: (-(row["differing"] or 0), _order(row["file"])))
    heads = ("file", "differing", "outputs", "first difference")
    folder = _folder(found)
    rows = [
        [row["file"].removeprefix(folder), *map(_count, (row["differing"], row["outputs"])), row["first_difference"]]
        for row in found
    ]
    lines = _paragraph(f"{total['bad']:,} of {count_text(total['files'], 'verified session')}{_below(folder)}.")
    return _section(title, lines, table(heads, rows, heads[1:3], (heads[0], heads[3])))


def _count(value: int | None) -> str | None:
    return None if value is None else f"{value:,}"


def _lags(questions: Questions) -> str:
    found = questions.rows(
        "SELECT fixed, stream, count(*) AS sessions, count(*) FILTER (has_lag) AS measured, "
        "median(lag_ms) AS median_ms, min(lag_ms) AS least_ms, max(lag_ms) AS largest_ms "
        f"FROM lags GROUP BY fixed, stream ORDER BY measured DESC, fixed, stream LIMIT {_MOST}"
    )
    if not found:
        return ""
    found.sort(key=lambda row: (-row["measured"], _order(row["fixed"]), _order(row["stream"])))
    heads = ("behind", "stream", "sessions", "with a lag", "median, ms", "least, ms", "largest, ms")
    rows = [
        [row["fixed"], row["stream"], f"{row['sessions']:,}", f"{row['measured']:,}"]
        + [None if row[key] is None else f"{row[key]:+,.1f}" for key in ("median_ms", "least_ms", "largest_ms")]
        for row in found
    ]
    return _section("Lags between streams", table(heads, rows, heads[2:], heads[:2]))


def _without_result(questions: Questions) -> str:
    known = ", ".join(f"'{status}'" for status in (OK, NOTHING))
    found = questions.rows(
        f"SELECT file, string_agg(verb, ', ' ORDER BY verb) AS verbs, any_value(status) AS status, any_value(error) AS "
        f"error FROM tasks WHERE status NOT IN ({known}) GROUP BY file"
    )
    if not found:
        return ""
    found.sort(key=lambda row: _order(row["file"]))
    heads = ("file", "verbs", "end", "reason")
    folder = _folder(found)
    rows: Sequence[Sequence[Any]] = [
        (row["file"].removeprefix(folder), row["verbs"], str(row["status"]).replace("_", " "), _reason(row))
        for row in found[:_MOST]
    ]
    more = len(found) - _MOST
    return _section(
        "Files without a result",
        _paragraph(f"{count_text(len(found), 'file')}{_below(folder)}."),
        table(heads, rows, (), (heads[0], heads[1], heads[3])),
        _paragraph(f"And {more:,} more, in the table tasks.") if more > 0 else "",
    )


def _folder(rows: Sequence[dict[str, Any]]) -> str:
    """Return the folder of all files, as their names begin with it; "" for none."""
    folders = [row["file"].split("/")[:-1] for row in rows]
    shared = [parts[0] for parts in itertools.takewhile(lambda each: len(set(each)) == 1, zip(*folders, strict=False))]
    return f"{'/'.join(shared)}/" if any(shared) else ""


def _below(folder: str) -> str:
    return f", in {folder}" if folder else ""


def _reason(row: dict[str, Any]) -> str:
    """Return why there is no result, without the name of the file, which stands beside it."""
    reason: str = row["error"] or ""
    return reason.removeprefix(f"{row['file']}: ")


def _more(questions: Questions) -> str:
    """What the page does not have, and the verbs that would add it."""
    found = {
        row["verb"]: row["files"] for row in questions.rows("SELECT verb, count(*) AS files FROM tasks GROUP BY ALL")
    }
    absent = [verb for verb in VERB_NAMES if not found.get(verb)]
    nothing = {
        row["verb"]
        for row in questions.rows(
            f"SELECT verb FROM tasks GROUP BY verb HAVING count(*) = count(*) FILTER (status = '{NOTHING}')"
        )
    }
    lines = []
    if absent:
        lines.append(f"Not asked yet: {', '.join(absent)} (igtl-gateway cohort VERB).")
    lines += [f"No session has anything for {verb}." for verb in VERB_NAMES if verb in nothing]
    return _section("Not on this page", *map(_paragraph, lines)) if lines else ""
