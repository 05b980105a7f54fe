"""``igtl-gateway export --to lerobot``: a starting recipe, a data set, or the check of one."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.processes import extras
from igtl_gateway.addon.reading import open_recording
from igtl_gateway.addon.terminal import aligned, count_text, print_json, print_line
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addon.writing import check_target, write_error, write_text, written
from igtl_gateway.addons.lerobot.options import LEROBOT
from igtl_gateway.addons.lerobot.recipe import IMAGES, OBSERVATION
from igtl_gateway.addons.lerobot.trace_verb import OF_TRACE, run_trace

if TYPE_CHECKING:
    from igtl_gateway.addons.lerobot.assembling import Part
    from igtl_gateway.addons.lerobot.export import Exported, Runner

_OPTIONS = {"recipe": "--recipe", "write_recipe": "--write-recipe", "check": "--check", "trace": "--trace"}
#: Sessions that the output lists.
_SESSIONS = 20
_COUNTS = ("messages", "unusable", "used", "interpolated", "held")
#: One in this many messages: a stream of which fewer are in frames is named.
_SPARSE = 10


def refuse_lerobot_options(options: argparse.Namespace) -> None:
    """Raise ConfigError for options of this format with another one."""
    for name, text in {**_OPTIONS, **OF_TRACE, "append": "--append"}.items():
        if getattr(options, name):
            raise ConfigError(f"{text}: found it with --to {options.to}, expected --to {LEROBOT}")


def run_lerobot(options: argparse.Namespace) -> int:
    """Write a recipe or a data set, or check one; return the exit code."""
    given = [text for name, text in _OPTIONS.items() if getattr(options, name) is not None]
    if options.append and (options.output is None or options.write_recipe or options.check or options.trace):
        raise ConfigError(
            "--append: expected it with -o, the data set, and without --write-recipe, --check and --trace"
        )
    if not options.append and len(given) != 1:
        raise ConfigError(f"--to {LEROBOT}: found {' and '.join(given) or 'none'}, expected one of "
                          f"{', '.join(_OPTIONS.values())}")  # fmt: skip
    if not options.append and (options.output is not None) != (options.recipe is not None):
        raise ConfigError("-o: found it or --recipe alone, expected both")
    if options.streams and not options.write_recipe:
        raise ConfigError(
            f"--streams: found it with --to {LEROBOT}, expected the streams in the recipe, or --write-recipe"
        )
    if not options.files and not (options.check or options.trace):
        raise ConfigError(f"--to {LEROBOT}: found no recording, expected one or more")
    for name, text in OF_TRACE.items():
        if getattr(options, name) is not None and not options.trace:
            raise ConfigError(f"{text}: found it without --trace, expected both")
    with extras.in_use(LEROBOT):
        if options.write_recipe:
            return _write_recipe(options)
        if options.trace:
            return run_trace(options)
        return _check(options) if options.check else export_set(options, options.files)


def _write_recipe(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.lerobot.drafting import draft

    if len(options.files) > 1:
        raise ConfigError(f"--write-recipe: found {len(options.files)} recordings, expected one: its recipe serves all")
    if options.write_recipe.exists():
        raise ConfigError(f"{options.write_recipe}: exists already, expected a new file")
    check_target(options.write_recipe, overwrite=False)
    with open_recording(options.files[0]) as recording:
        made = draft(recording, options.streams)
    with written(options.write_recipe) as path:
        write_text(path, made.text)
    if options.json:
        facts = {"fps": made.fps, "rate_of": made.stream, "reason": made.reason, "costs": list(made.costs)}
        print_json({"file": str(options.files[0]), "to": LEROBOT, "recipe": str(options.write_recipe), **facts})
    else:
        print_line(f"{options.write_recipe}: a recipe to start with; edit task, and the names of the features")
        print_line(printable(f"fps = {made.fps}: {made.reason}"))
        for each in made.costs:
            print_line(printable(f"  {each}"))
    return 0


def _check(options: argparse.Namespace) -> int:
    from igtl_gateway.addons.lerobot.comparing import check

    checked = check(options.check, options.files)
    findings = checked.findings
    if options.json:
        files: dict[str, Any] = {"file": str(options.files[0])} if options.files else {}
        if options.files[1:]:
            files["files"] = list(map(str, options.files))
        print_json({**files, "to": LEROBOT, "check": str(options.check), "findings": findings, "notes": checked.notes})
    else:
        for each in findings:
            print_line(f"! {each}")
        for each in checked.notes:
            print_line(f"note: {each}")
        found = checked.found
        size = "" if found is None else (
            f"{count_text(sum(each.length for each in found.episodes), 'frame')} in "
            f"{count_text(len(found.episodes), 'episode')}, "
        )  # fmt: skip
        print_line(f"{options.check}: {size}{count_text(len(findings), 'finding')}")
    return int(bool(findings))


def export_set(options: argparse.Namespace, files: Sequence[Path], do: Runner | None = None) -> int:
    """Write a data set of sessions or add them to one, and print what is in it; return the exit code.

    Args:
        options: with ``recipe``, ``output``, ``append`` and ``json``.
        files: the recordings.
        do: runs the jobs of the sessions; None: this process.
    """
    from igtl_gateway.addons.lerobot.appending import append_sessions
    from igtl_gateway.addons.lerobot.export import export_sessions, here

    write = append_sessions if options.append else export_sessions
    recipe = options.recipe or options.output / "meta" / "recipe.toml"
    try:
        done = write(files, options.recipe, options.output, do or here)
    except GatewayError as error:
        text = str(error)
        places = [str(place) for file in files for place in (file, file.absolute())]
        known = str(recipe), *places, str(options.output), str(options.output.resolve()), "cannot write", "the data set"
        raise type(error)(text if text.startswith(known) else f"{recipe}: {text}") from None
    except OSError as error:
        raise write_error(options.output, error) from None
    if len(files) == 1:
        _print_one(options, files[0], done)
    else:
        _print_many(options, done)
    return 0


def _print_one(options: argparse.Namespace, file: Path, done: Exported) -> None:
    from igtl_gateway.addons.lerobot.splits import MOST_LISTED, divided, listed

    [part] = done.parts
    found, recipe = part.written, done.recipe
    if options.json:
        print_json(
            {
                "file": str(file), "to": LEROBOT, "out": str(options.output), "format": recipe.format,
                "clock": found["clock"], **_size(options, done), "files": done.files,
                "notes": found["notes"], "demonstrations": found["demonstrations"], "empty": found["empty"],
                "cuts": len(found["owners"]) - len(set(found["owners"])), "splits": done.splits,
                "left_out": found["left_out"], "streams": found["streams"],
                "sparse": _sparse(found["streams"], recipe.fps), "strings": _strings(done),
            }
        )  # fmt: skip
        return
    _print_streams(found["streams"])
    _print_losses(found["streams"], recipe.fps)
    _print_strings(done)
    for note in found["notes"]:
        print_line(f"note: {note}")
    _print_left_out(found["left_out"])
    if found["empty"]:
        print_line(f"note: demonstrations without a frame: {listed(found['empty'])}, of {found['demonstrations']:,}")
    parts = divided(found["owners"])
    for owner, episodes in list(parts.items())[:MOST_LISTED]:
        numbers = f"episodes {episodes[0]} to {episodes[-1]}"
        print_line(f"note: demonstration {owner} has a gap above a tolerance, or is too long: {numbers}")
    if len(parts) > MOST_LISTED:
        print_line(f"note: {len(parts) - MOST_LISTED:,} more demonstrations that are several episodes")
    _print_end(options, done, found["clock"])


def _print_many(options: argparse.Namespace, done: Exported) -> None:
    """What is in a set of several sessions; numbers of streams are those of all of them."""
    from igtl_gateway.addons.lerobot.export import distinct_names

    streams = _summed(done.parts)
    left_out: Counter[str] = sum((Counter(each.written["left_out"]) for each in done.parts), Counter())
    rows = [_session(each) for each in _numbered(done)]
    clock = done.parts[0].written["clock"]
    if options.json:
        print_json(
            {
                "files": [each.session.path for each in done.parts], "to": LEROBOT, "out": str(options.output),
                "format": done.recipe.format, "clock": clock, **_size(options, done), "written": done.files,
                "splits": done.splits, "left_out": dict(left_out), "sessions": rows, "streams": streams,
                "sparse": _sparse(streams, done.recipe.fps), "strings": _strings(done),
            }
        )  # fmt: skip
        return
    names = distinct_names([each.session.path for each in done.parts])
    cells = [
        (printable(name), row["split"], f"{row['first_episode']:,}", f"{row['episodes']:,}",
         f"{row['frames']:,}")
        for name, row in zip(names[:_SESSIONS], rows, strict=False)
    ]  # fmt: skip
    print_line(*aligned([("session", "split", "first episode", "episodes", "frames"), *cells], left=2))
    if len(rows) > _SESSIONS:
        print_line(f"  {len(rows) - _SESSIONS:,} more sessions: {options.output}/meta/sessions.json")
    _print_streams(streams)
    _print_losses(streams, done.recipe.fps)
    _print_strings(done)
    notes = sum(bool(row["notes"]) for row in rows)
    if notes:
        print_line(f"note: the clock of {count_text(notes, 'session')} was corrected: meta/SYNCHRONIZATION.md")
    _print_left_out(left_out)
    divided = sum(row["cuts"] for row in rows)
    if divided:
        print_line(f"note: {count_text(divided, 'episode')} more than demonstrations: gaps, or too long for one")
    _print_end(options, done, clock)


def _numbered(done: Exported) -> list[tuple[int, Part]]:
    first = done.totals.episodes - sum(len(each.session.episodes) for each in done.parts)
    found = []
    for each in done.parts:
        found.append((first, each))
        first += len(each.session.episodes)
    return found


def _session(numbered: tuple[int, Part]) -> dict[str, Any]:
    first, part = numbered
    owners = part.written["owners"]
    return {
        "session": part.session.name, "group": part.group, "split": part.split, "first_episode": first,
        "episodes": len(part.session.episodes), "frames": part.session.frames, "cuts": len(owners) - len(set(owners)),
        "demonstrations": part.written["demonstrations"], "empty": part.written["empty"],
        "notes": part.written["notes"],
    }  # fmt: skip


def _summed(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """The rows of the streams, with the sums of all sessions."""
    every = zip(*(each.written["streams"] for each in parts), strict=True)
    return [
        {
            **rows[0],
            **{name: sum(row[name] for row in rows) for name in (*_COUNTS, "within")},
            **{name: max(row[name] for row in rows) for name in ("furthest_ms", "outside")},
            "rate_hz": median([row["rate_hz"] for row in rows]),
        }
        for rows in every
    ]


def _print_streams(facts: Sequence[Mapping[str, Any]]) -> None:
    names = ("feature", "stream", "rule", *_COUNTS)
    rows = [(*(_cell(each[name]) for name in names), f"{each['furthest_ms']:,.1f} ms") for each in facts]
    print_line(*aligned([(*names, "furthest"), *rows], left=3))


def _sparse(facts: Sequence[Mapping[str, Any]], fps: int) -> list[dict[str, Any]]:
    """The streams of which the frames have few messages, because others have fewer."""
    return [
        {**{name: each[name] for name in ("feature", "stream", "rate_hz", "used", "within", "native")}, "fps": fps}
        for each in facts
        if each["rate_hz"] > fps and each["used"] * _SPARSE < each["within"]
    ]


def _print_losses(facts: Sequence[Mapping[str, Any]], fps: int) -> None:
    for each in _losses(facts, fps):
        print_line(printable(f"note: {each}"))


def _losses(facts: Sequence[Mapping[str, Any]], fps: int) -> Iterator[str]:
    """What the frames have less of than the recording: depth, strings, messages."""
    for each in facts:
        if each["outside"]:
            text = f"{each['outside']:.1%} of the depth is unknown, or outside of depth_mm, and has one of its ends"
            yield f"{each['stream']}: {text}"
        usable = each["messages"] - each["unusable"]
        if each["rule"] == "none" and each["used"] < usable:
            more = "" if each["used"] else '; rule = "hold" gives each frame the last one'
            text = f"{usable - each['used']:,} of {count_text(usable, 'string')} in no frame: outside of the episodes"
            yield f"{each['stream']}: {text}{more}"
    for each in _sparse(facts, fps):
        if each["native"]:  # a table has all of them
            continue
        more = "" if each["feature"].startswith(IMAGES) else ", native = true all"
        yield (
            f"{each['stream']} has {each['rate_hz']:,.4g} Hz, the frames {fps}: {each['used']:,} of "
            f"{count_text(each['within'], 'message')} are in a frame; a larger fps takes more{more}"
        )


def _strings(done: Exported) -> list[str]:
    """Features of strings of which LeRobot 0.6 would make one tensor, for policies that take several observations."""
    features = done.parts[0].written["features"].items() if done.recipe.format != "v2.1" else ()
    return [name for name, facts in features if facts["dtype"] == "string" and name.startswith(OBSERVATION)]


def _print_strings(done: Exported) -> None:
    for name in _strings(done):
        other = f"meta.{name.rpartition('.')[2]}"
        print_line(f"note: {name}: policies of several observations fail at strings of this name, but not {other}")


def _print_left_out(left_out: Mapping[str, int]) -> None:
    for why, number in left_out.items():
        print_line(f"note: {count_text(number, 'frame')} left out: {why}")


def _size(options: argparse.Namespace, done: Exported) -> dict[str, Any]:
    """Episodes and frames of the set, and what was added to it."""
    found: dict[str, Any] = {"episodes": done.totals.episodes, "frames": done.totals.frames}
    if options.append:
        sessions = [each.session for each in done.parts]
        found["appended"] = {
            "sessions": len(sessions), "episodes": sum(len(each.episodes) for each in sessions),
            "frames": sum(each.frames for each in sessions),
        }  # fmt: skip
    return found


def _print_end(options: argparse.Namespace, done: Exported, clock: str) -> None:
    if done.recipe.splits:
        print_line("splits: " + ", ".join(f"{name} has the episodes {text}" for name, text in done.splits.items()))
    size, listed = _size(options, done), done.totals.sessions
    sessions = f" of {count_text(len(listed.sessions), 'session')}" if listed.sessions[1:] else ""
    others = f", episodes of another program: {listed.others:,}" if listed.others else ""
    added = size.get("appended")
    added = f", of which {_in(added)} were appended" if added else ""
    print_line(f"{options.output}: LeRobot {done.recipe.format}, {_in(size)}{sessions}{added}{others}, clock: {clock}")


def _in(size: Mapping[str, Any]) -> str:
    return f"{count_text(size['frames'], 'frame')} in {count_text(size['episodes'], 'episode')}"


def _cell(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else str(value)
