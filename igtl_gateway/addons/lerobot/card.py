"""The card of a data set: ``meta/README.md`` and ``meta/SYNCHRONIZATION.md``, generated, with what is not known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from igtl_gateway.addon import __version__
from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addons.lerobot.card_streams import Facts
from igtl_gateway.addons.lerobot.depth import step_of
from igtl_gateway.addons.lerobot.frames import Plan
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.splits import MOST_LISTED, divided, listed
from igtl_gateway.addons.sync.lag import Lag, Verdict

_UNKNOWN = "not stated"
#: Heading → its entries.  An entry of the recipe's table [card] with this name replaces "not stated".
HEADINGS = {
    "Tasks and domain": ("domain", "skills"),
    "Data collection details": ("method", "operators", "period", "recovery_demonstrations"),
    "Diversity dimensions": (
        "camera", "lighting", "object", "layout", "embodiment", "execution", "background",
    ),
    "Equipment and setup": ("robots", "sensors"),
    "Attribution and contact": ("lead", "institution", "email", "bibtex"),
}  # fmt: skip
_OVERVIEW = ("data_type", "license", "version")


@dataclass(frozen=True, slots=True)
class CardFacts:
    """What the card has about a data set.

    Attributes:
        recipe: of the set.
        tasks: in the order of their numbers.
        sessions, episodes, frames: their number; no sessions where they are not known.
        splits: name → its episodes.
        unaligned: episodes with streams that were not aligned.
        spaces: lines about the features.
        approach: lines about clock and sampling.
        notes: of the clocks, of all sessions.
        others: episodes of another program.
    """

    recipe: Recipe
    tasks: Sequence[str]
    sessions: int
    episodes: int
    frames: int
    splits: Mapping[str, str]
    unaligned: int
    spaces: Sequence[str]
    approach: Sequence[str]
    notes: Sequence[str]
    others: int = 0


def card(facts: CardFacts) -> str:
    """Return ``meta/README.md``."""
    return "\n".join(_readme(facts)) + "\n"


def synchronization(plan: Plan, streams: list[Facts], name: str) -> str:
    """Return the part of a session, whose file has this name, in ``meta/SYNCHRONIZATION.md``."""
    return "\n".join(_synchronization(plan, streams, name)) + "\n"


def _cell(text: str) -> str:
    """Foreign text in a cell of a table, or in a line."""
    safe = printable(text.replace("\n", " "))
    return safe.translate({ord(each): f"\\{each}" for each in "\\|<>[]*`"})


def _readme(facts: CardFacts) -> Iterator[str]:
    recipe, card = facts.recipe, dict(facts.recipe.card or {})

    def stated(name: str) -> str:
        return _cell(card.pop(name, _UNKNOWN))

    hours = facts.frames / recipe.fps / 3600
    yield f"# {stated('title') if 'title' in card else _cell(recipe.task)}"
    yield ""
    yield "## At a glance"
    yield ""
    yield stated("summary")
    yield ""
    yield "## Dataset overview"
    yield ""
    yield from _rows(
        ("total trajectories", f"{facts.episodes:,}"),
        ("sessions", f"{facts.sessions:,}"),
        *(
            [("episodes of another program, about which the rest states nothing", f"{facts.others:,}")]
            * bool(facts.others)
        ),
        *((f"split {_cell(name)}", f"episodes {text}") for name, text in facts.splits.items()),
        ("total hours", f"{hours:.3f}"),
        ("frames", f"{facts.frames:,} at {recipe.fps} per second"),
        ("format", f"LeRobot {recipe.format}"),
        ("robot type", _cell(recipe.robot_type)),
        *((name.replace("_", " "), stated(name)) for name in _OVERVIEW),
        ("made by", f"igtl-gateway {__version__}, `export --to lerobot`; recipe: `recipe.toml`"),
    )
    for heading, names in HEADINGS.items():
        yield from ("", f"## {heading}", "")
        if heading == "Tasks and domain":
            yield from (f"* task {number}: {_cell(text)}" for number, text in enumerate(facts.tasks))
        yield from (f"* {name.replace('_', ' ')}: {stated(name)}" for name in names)
    yield from ("", "## Action and state space", "")
    yield from facts.spaces
    yield from ("", "## Data synchronization approach", "")
    yield from facts.approach
    yield from _notes(facts.notes)
    yield f"**Episodes with streams that were not aligned: {facts.unaligned:,} of {facts.episodes - facts.others:,}.**"
    yield "[SYNCHRONIZATION.md](SYNCHRONIZATION.md) has rates, jitter, gaps and measured lags of each stream."
    yield from ("", "## Frames and messages", "")
    yield (
        "`provenance.parquet`, of further sessions `provenance-000001.parquet` …, has for each frame (`index`) its "
        "time (`time_ns`), and for each stream entry number and stamp of the messages that it was made of; "
        "`sessions.json` has the sessions. Readers of LeRobot ignore these files."
    )
    if card:
        yield from ("", "## Further statements", "")
        yield from (f"* {_cell(name)}: {_cell(text)}" for name, text in card.items())


def _rows(*rows: tuple[str, ...], titles: tuple[str, ...] = ("", "")) -> Iterator[str]:
    yield f"| {' | '.join(titles)} |"
    yield f"|{'---|' * len(titles)}"
    yield from (f"| {' | '.join(row)} |" for row in rows)


def spaces(plan: Plan) -> Iterator[str]:
    """Yield the lines about the features."""
    rows = []
    for name in plan.recipe.names:
        samples = plan.of(name)
        source = plan.recipe.features[plan.recipe.rows(name)[0]].next_of
        of = " + ".join(f"`{_cell(each.row.stream)}`" for each in samples)
        kind = plan.kind(name)
        content = {"picture": "video", "text": "text"}.get(kind) or ", ".join(map(_cell, plan.names(name)))
        rows.append((f"`{name}`", f"next value of `{source}`" if source else of, content, _representation(plan, name)))
    yield from _rows(*rows, titles=("feature", "from", "content", "representation"))
    yield from ("", "Lengths are in metres, angles of poses in radians, quaternions x, y, z, w with w ≥ 0.")
    yield "Numbers without a unit in their name have that of the recorded message."
    if plan.recipe.has_next:
        yield "An action that is a next value is measured 1 / fps later; it is not a command of the recording."


def _representation(plan: Plan, name: str) -> str:
    """Orientation and frames of poses; size and window of pictures."""
    found = []
    for each in plan.of(name):
        if each.kind == "pose":
            found.append(f"pose, absolute, orientation: {each.row.orientation.replace('_', ' ')}")
        if each.pictures is not None:
            (rows, columns), (high, wide) = each.pictures.size, each.pictures.padded
            padding = f", repeated to {wide} × {high}" if (high, wide) != (rows, columns) else ""
            if each.row.depth_mm:
                near, far = each.row.depth_mm
                padding += f", depth from {near:g} to {far:g} mm in steps of {step_of(each.row.depth_mm):.4g} mm"
                padding += f"; unknown depth is {near:g} mm"
            window = f", {each.row.window[0]:g} is black and {each.row.window[1]:g} is white" if each.row.window else ""
            found.append(f"{columns} × {rows} pixels{padding}{window}")
    return "; ".join(dict.fromkeys(found))


def approach(recipe: Recipe, name: str) -> Iterator[str]:
    """Yield the lines about the clock of this name, and about sampling."""
    clock = {
        "source": "the stamps of the senders (`header.stamp` of ROS; every message has one)",
        "gateway": "the times at which the gateway received the messages, so delays of transport are part of them",
    }[name]
    yield f"Frames are {recipe.fps} per second, on {clock}. A frame is the state of all streams at one moment:"
    yield "streams are sampled at that moment, and `timestamp` is frame index / fps. Rules of sampling:"
    yield ""
    yield "* `nearest`: the message nearest in time, before or after the frame."
    yield "* `hold`: the last message not after the frame; nothing of the future is in it."
    yield "* `interpolate`: numbers and positions linearly, rotations by SLERP, between the messages before and after."
    yield "* `none`: a string is in the frame nearest to it; the others have an empty one."
    yield ""
    yield "An episode ends where a stream has a gap above its tolerance, unless the recipe holds the last sample."
    yield ""


def _notes(notes: Sequence[str]) -> Iterator[str]:
    for note in notes[:MOST_LISTED]:
        yield from (_cell(f"Note: {note}."), "")
    if len(notes) > MOST_LISTED:
        yield from (f"{len(notes) - MOST_LISTED:,} more notes: SYNCHRONIZATION.md.", "")


def _synchronization(plan: Plan, streams: list[Facts], name: str) -> Iterator[str]:
    yield f"# Synchronization of {_cell(name)}"
    yield ""
    yield "Generated from the recording by igtl-gateway. Times are in milliseconds."
    yield ""
    yield from approach(plan.recipe, plan.clock)
    yield from _notes(plan.joined.notes)
    yield from ("## Streams", "")
    titles = (
        "feature", "stream", "messages", "unusable", "duplicate", "out of order", "rate", "jitter", "largest gap",
        "gaps",
    )  # fmt: skip
    rows = []
    for each in streams:
        one = each.samples
        rows.append((
            _label(plan, each), f"`{_cell(one.row.stream)}`", f"{one.count:,}", f"{one.unusable:,}",
            f"{one.duplicates:,}", f"{one.disordered:,}", f"{each.rate_hz:.2f} Hz" if each.rate_hz else "one sample",
            f"{each.jitter_ms:.3f}", f"{each.largest_ms:.1f}", f"{each.gaps:,}",
        ))  # fmt: skip
    yield from _rows(*rows, titles=titles)
    yield from (
        "",
        "Jitter is the standard deviation of the intervals; gaps are intervals above three median ones.",
        "",
    )
    yield from ("## Frames", "")
    uses_titles = (
        "feature",
        "rule",
        "tolerance",
        "samples used",
        "left over",
        "interpolated",
        "held",
        "cuts",
        "missing",
        "distance",
        "largest",
    )
    uses = []
    for each in streams:
        row = each.samples.row
        tolerance = "any" if row.tolerance_ms is None else f"{row.tolerance_ms:g}"
        uses.append((
            _label(plan, each), row.rule, tolerance, f"{each.used:,}", f"{len(each.samples.times) - each.used:,}",
            f"{each.interpolated:,}", f"{each.held:,}", f"{each.cuts:,}", f"{each.missing_s:.2f} s",
            f"{each.median_ms:.2f}", f"{each.furthest_ms:.2f}",
        ))  # fmt: skip
    yield from _rows(*uses, titles=uses_titles)
    yield ""
    yield (
        f"The session has {count_text(plan.frame_count, 'frame')} in "
        f"{count_text(len(plan.episodes), 'episode')}. Distance is the median,"
    )
    yield "over the frames, of the time between frame and sample (of two samples, the further one). Cuts are times"
    yield "without a value by the rule, between the first and the last sample; missing is their sum."
    yield ""
    yield f"* demonstrations: {len(set(plan.owners)):,} with frames, of {plan.demonstrations:,}"
    if plan.empty:
        yield f"* demonstrations without a frame: {listed(plan.empty)}"
    yield f"* episodes beyond one for each demonstration: {plan.cuts:,}"
    for owner, episodes in divided(plan.owners).items():
        begin, end = (plan.place.episode + each for each in (episodes[0], episodes[-1]))
        yield f"* demonstration {owner} has a gap, or is too long: episodes {begin} to {end}"
    yield from (f"* split {_cell(name)}: episodes {text}" for name, text in plan.splits.items())
    yield from (f"* left out: {count_text(number, 'frame')}: {why}" for why, number in plan.left_out.items())
    yield from ("", "## Lags", "")
    first = streams[0].samples.row.stream
    yield f"Lags of the recorded stamps behind `{_cell(first)}`, from what moves in both (`igtl-gateway sync`)."
    yield "A positive lag: the stamps of the stream are late."
    yield ""
    yield from _rows(*_lag_rows(streams), titles=("stream", "lag", "95 %", "skew", "verdict", "subtracted"))
    unmeasured = sum(not (isinstance(each.lag, Lag) and each.lag.verdict is Verdict.MEASURED) for each in streams[1:])
    yield ""
    yield f"Not measured: {unmeasured} of {len(streams) - 1}. For these, nothing is known beyond the stamps."
    yield from ("", "## Episodes with streams that were not aligned", "")
    yield f"Streams whose stamps are used as recorded, although a lag of 0 behind `{_cell(first)}` was not measured."
    yield ""
    numbered = enumerate(unaligned(plan, streams), plan.place.episode)
    rows_of_episodes = [(f"{number}", ", ".join(names) or "none") for number, names in numbered]
    yield from _rows(*rows_of_episodes, titles=("episode", "not aligned"))


def unaligned(plan: Plan, streams: list[Facts]) -> Iterator[list[str]]:
    """Yield for each episode the streams that were not aligned, with their lags."""
    names = {each.index: name for each in streams if (name := _not_aligned(each))}
    for episode in plan.episodes:
        used = [name for index, name in names.items() if episode.picks[index] is not None]
        yield list(dict.fromkeys(used))


def _not_aligned(facts: Facts) -> str:
    """Name and lag of a stream that was not aligned; empty for an aligned one and for the reference."""
    if facts.samples.correction is not None or facts.lag == "":
        return ""
    name = f"`{_cell(facts.samples.row.stream)}`"
    match facts.lag:
        case Lag(verdict=Verdict.MEASURED) as lag:
            return "" if lag.low_s <= 0 <= lag.high_s else f"{name} (lag {lag.lag_s * 1e3:+.1f})"
        case _:
            return f"{name} (lag unknown)"


def _label(plan: Plan, facts: Facts) -> str:
    name = facts.samples.row.name
    rows = plan.recipe.rows(name)
    return f"`{name}`" if len(rows) == 1 else f"`{name}` ({rows.index(facts.index) + 1} of {len(rows)})"


def _lag_rows(streams: list[Facts]) -> Iterator[tuple[str, ...]]:
    seen = set()
    for each in streams:
        samples = each.samples
        key = (samples.row.stream, samples.row.frame, samples.correction)
        if key in seen:
            continue
        seen.add(key)
        done = samples.correction
        subtracted = "nothing" if done is None else f"{done.lag_ns / 1e6:+.1f}, behind {_cell(done.behind)}"
        if done is not None and done.skew_ppm:
            subtracted += f", and {done.skew_ppm:+.0f} ppm"
        name = f"`{_cell(samples.row.stream)}`"
        match each.lag:
            case Lag(verdict=verdict) as lag if verdict.has_lag:
                skew = f"{lag.skew_ppm:+.0f} ppm" if lag.has_skew else "none found"
                interval = f"{lag.low_s * 1e3:+.1f} to {lag.high_s * 1e3:+.1f}"
                yield name, f"{lag.lag_s * 1e3:+.1f}", interval, skew, verdict.value, subtracted
            case Lag(verdict=verdict):
                yield name, "unknown", "", "", verdict.value, subtracted
            case str(why):
                yield name, "0" if not why else "unknown", "", "", _cell(why) or "reference", subtracted
