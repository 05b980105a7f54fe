"""The report of a cohort: one page without links to anything, made of questions to the tables."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import __version__
from igtl_gateway.addons.cohort.charts import bars, shares, table, text
from igtl_gateway.addons.cohort.ends import NOTHING, OK, VERB_NAMES

if TYPE_CHECKING:
    from igtl_gateway.addons.cohort.query import Questions

#: Rows of a list; the tables have all.
_MOST = 40
#: Upper bounds of the classes of depth noise, mm.
_NOISE_MM = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.6, 1.0)

_STYLE = """
body { font: 15px/1.5 sans-serif; max-width: 54rem; margin: 2rem auto; padding: 0 1rem; color: #222; background: #fff }
h2 { margin-top: 2.5rem; border-bottom: 1px solid #ccc }
svg { width: 100%; height: auto; font-size: 12px } rect { fill: #7ab } rect.marked { fill: #c40 }
table { border-collapse: collapse; font-size: 13px } td, th { text-align: left; padding: 2px 12px 2px 0 }
td { vertical-align: top; overflow-wrap: anywhere } .key { color: #c40 }
"""


def page(questions: Questions, folder: str) -> str:
    """Return the page (HTML)."""
    sections = [_ends(questions), _stitches(questions), _latencies(questions), _findings(questions)]
    sections += [_differences(questions), _lags(questions), _without_result(questions)]
    title = f"Cohort {text(folder)}"
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head>"
        f"<body><h1>{title}</h1><p>Made by igtl-gateway {text(__version__)}. "
        f"Method of each verb: docs/how-to/cohort.md.</p>"
        f"{''.join(sections)}</body></html>\n"
    )


def _section(title: str, *parts: str) -> str:
    return f"<h2>{text(title)}</h2>{''.join(parts)}"


def _paragraph(line: str) -> str:
    return f"<p>{text(line)}</p>"


def _rows(found: Sequence[dict[str, Any]]) -> list[list[object]]:
    return [list(row.values()) for row in found]


def _ends(questions: Questions) -> str:
    found = questions.rows(
        "SELECT verb, status, count(*) AS files, round(sum(bytes) / 1e6, 1) AS mb, round(sum(seconds), 1) AS s "
        "FROM tasks GROUP BY verb, status ORDER BY verb, files DESC"
    )
    [total] = questions.rows(
        "SELECT count(*) AS files, coalesce(sum(duration_s), 0) / 3600 AS hours, sum(entries) AS entries FROM sessions"
    )
    known = f", {total['hours']:.1f} h, {total['entries']:,} entries" if total["entries"] else ""
    heads = ("verb", "end", "files", "MB", "seconds of work")
    return _section("Sessions", _paragraph(f"{total['files']:,} files{known}."), table(heads, _rows(found)))


def _stitches(questions: Questions) -> str:
    """Of the stitches of the first plans: which were corrected later, by the noise where they were planned."""
    title = "Stitches that had to be corrected"
    [total] = questions.rows(
        "SELECT count(*) AS sessions, sum(plans) AS plans, sum(stitches) AS stitches, sum(corrected) AS corrected, "
        "sum(wrong_first) AS wrong_first, sum(wrong_last) AS wrong_last FROM reviews"
    )
    if not total["sessions"]:
        return _section(title, _paragraph("No session has a review: igtl-gateway cohort review."))
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
    unknown = sum(row["noise_mm"] is None for row in planned)
    first = questions.rows(
        "SELECT level, count(*) FILTER (is_first) AS first, count(*) FILTER (is_last) AS last "
        "FROM stitches GROUP BY level ORDER BY level"
    )
    return _section(
        title,
        _paragraph(
            f"{total['plans']:,} versions of plans in {total['sessions']:,} sessions; of "
            f"{total['stitches']:,} stitches of the last versions, {total['corrected']:,} were corrected after the "
            f"first version. Wrong: {total['wrong_first']:,} in the first, {total['wrong_last']:,} in the last."
        ),
        "<p>Stitches of the first versions by depth noise, and "
        '<span class="key">those that were corrected later</span>, with their share.</p>',
        shares(classes, "depth noise where the stitch was planned, mm (the larger of both ends)"),
        _paragraph(f"{unknown:,} stitches without a known noise.") if unknown else "",
        table(("level", "first versions", "last versions"), _rows(first)),
    )


def _latencies(questions: Questions) -> str:
    title = "Latency by peer"
    found = questions.rows(
        "SELECT host, count(DISTINCT file) AS files, sum(messages) AS messages, median(least_ms) AS least_ms, "
        "median(jitter_ms) AS jitter_ms, quantile_cont(spread_ms, 0.95) AS spread_ms FROM latencies "
        f"WHERE least_ms IS NOT NULL GROUP BY host ORDER BY spread_ms DESC LIMIT {_MOST}"
    )
    if not found:
        return _section(title, _paragraph("No session has stamps: igtl-gateway cohort lint."))
    drawn = [
        (row["host"], row["spread_ms"], f"{row['spread_ms']:,.{1 if row['spread_ms'] >= 0.1 else 4}f} ms")
        for row in found
    ]
    cells = [
        [row["host"], row["files"], f"{row['messages']:,}", *(f"{row[key]:,.2f}" for key in _LATENCIES)]
        for row in found
    ]
    return _section(
        title,
        _paragraph(
            "Age of the messages when they arrive, by the stamps of the sender. The least age contains the offset "
            "of the clocks; the spread (largest less least age) does not. Bars: 95th percentile of the spread."
        ),
        bars(drawn),
        table(("peer", "files", "messages", "least age, ms", "jitter, ms", "spread p95, ms"), cells),
    )


_LATENCIES = ("least_ms", "jitter_ms", "spread_ms")


def _findings(questions: Questions) -> str:
    title = "What lint finds most"
    found = questions.rows(
        "SELECT rule, any_value(title) AS title, count(DISTINCT file) AS files, count(*) AS cases FROM findings "
        f"GROUP BY rule ORDER BY files DESC, rule LIMIT {_MOST}"
    )
    if not found:
        return _section(title, _paragraph("No findings, or no lint yet: igtl-gateway cohort lint."))
    drawn = [(f"{row['rule']} {row['title']}", row["files"], f"{row['files']:,} files") for row in found]
    return _section(title, bars(drawn), table(("rule", "finding", "files", "cases"), _rows(found)))


def _differences(questions: Questions) -> str:
    title = "Sessions that do not verify"
    [total] = questions.rows("SELECT count(*) AS files, count(*) FILTER (NOT good) AS bad FROM verifications")
    if not total["files"]:
        return _section(title, _paragraph("No session was verified: igtl-gateway cohort verify."))
    found = questions.rows(
        "SELECT file, differing, outputs, first_difference FROM verifications WHERE NOT good "
        f"ORDER BY differing DESC, file LIMIT {_MOST}"
    )
    lines = _paragraph(f"{total['bad']:,} of {total['files']:,}.")
    return _section(title, lines, table(("file", "differing", "outputs", "first difference"), _rows(found)))


def _lags(questions: Questions) -> str:
    found = questions.rows(
        "SELECT fixed, stream, count(*) AS sessions, count(*) FILTER (has_lag) AS measured, "
        "round(median(lag_ms), 1) AS median_ms, round(min(lag_ms), 1) AS least_ms, round(max(lag_ms), 1) AS largest_ms "
        f"FROM lags GROUP BY fixed, stream ORDER BY measured DESC, fixed, stream LIMIT {_MOST}"
    )
    if not found:
        return ""
    heads = ("behind", "stream", "sessions", "with a lag", "median, ms", "least, ms", "largest, ms")
    return _section("Lags between streams", table(heads, _rows(found)))


def _without_result(questions: Questions) -> str:
    known = ", ".join(f"'{status}'" for status in (OK, NOTHING))
    found = questions.rows(
        f"SELECT file, string_agg(verb, ', ' ORDER BY verb) AS verbs, any_value(status) AS status, any_value(error) AS "
        f"error FROM tasks WHERE status NOT IN ({known}) GROUP BY file ORDER BY file"
    )
    if not found:
        return _section("Files without a result", _paragraph(f"None ({', '.join(VERB_NAMES)})."))
    more = len(found) - _MOST
    return _section(
        "Files without a result",
        _paragraph(f"{len(found):,} files."),
        table(("file", "verbs", "end", "reason"), _rows(found[:_MOST])),
        _paragraph(f"And {more:,} more, in the table tasks.") if more > 0 else "",
    )
