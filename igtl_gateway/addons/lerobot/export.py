"""``export --to lerobot`` and ``cohort export``: sessions and a recipe → one data set.

All sessions are described and compared before anything is written.  Their order in the set is that of their splits and
of time, and each has files of its own, so neither the order in which they are named nor the number of workers changes a
byte.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, GatewayError
from igtl_gateway.addon.terminal import count_text, few_text
from igtl_gateway.addon.untrusted import check_limit, printable, read_bytes
from igtl_gateway.addon.writing import make_folder, written_folder
from igtl_gateway.addons.lerobot.assembling import Part, SetSoFar, assemble, split_ranges
from igtl_gateway.addons.lerobot.frames import MAX_FRAMES, Place
from igtl_gateway.addons.lerobot.parts import DESCRIBE, WRITE, Job, run_job
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.schema import Described, Schema, differences, schema_of
from igtl_gateway.addons.lerobot.splits import Group, assigned, check_kept, group_of, has_ranges, unused_names
from igtl_gateway.addons.lerobot.writing import check_out

#: Sessions that an error lists.
_MOST = 5
_PARTS = ".igtl-gateway-parts"


@dataclass(frozen=True, slots=True)
class Reply:
    """The result of a job: its reply, or the error."""

    value: Mapping[str, Any]
    error: Exception | None = None


#: Does jobs, in any order, and yields the number of each with its reply.
Runner = Callable[[Sequence[Job]], Iterator[tuple[int, Reply]]]


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written.

    Attributes:
        recipe: of the set.
        parts: of the sessions, in their order in the set.
        totals: what the set has now.
        splits: name → its episodes.
        files: number of files of the set.
    """

    recipe: Recipe
    parts: Sequence[Part]
    totals: SetSoFar
    splits: Mapping[str, str]
    files: int


def here(
    jobs: Sequence[Job], run: Callable[[Mapping[str, Any]], Mapping[str, Any]] = run_job
) -> Iterator[tuple[int, Reply]]:
    """Do jobs in this process, one after the other; ``run`` does one, and returns its reply."""
    for number, job in enumerate(jobs):
        try:
            yield number, Reply(run(job.to_dict()))
        except OSError as error:
            # a part that cannot be written is a matter of the set, a recording that cannot be read one of the session
            text = str(error.strerror or error).removeprefix(f"{job.path}: ")
            yield number, Reply({}, GatewayError(f"{job.path}: {text}") if job.kind == DESCRIBE else error)
        except GatewayError as error:
            yield number, Reply({}, error)


def export_lerobot(path: Path, recipe_path: Path, out: Path) -> Exported:
    """Write a data set of one session; see `export_sessions`."""
    return export_sessions([path], recipe_path, out)


def export_sessions(paths: Sequence[Path], recipe_path: Path, out: Path, do: Runner = here) -> Exported:
    """Write a data set to a new or empty directory.

    Args:
        paths: of the recordings, in any order.
        recipe_path: of the recipe.
        out: the directory.
        do: runs the jobs of the sessions.

    Raises:
        ConfigError: the recipe does not fit, or sessions differ; the error names them.
        GatewayError: a session cannot be read, or has no frame.
        OSError: the set cannot be written.
    """
    recipe, text = read_recipe(recipe_path), read_bytes(recipe_path)
    check_out(out)
    sessions = describe(paths, recipe_path, recipe, do)
    schema = schema_of(sessions)
    check_schema(sessions, schema, recipe)
    new = Batch(sessions, recipe_path, recipe, text, schema)
    with written_folder(out) as root:
        return write_batch(root, new, SetSoFar(), do)


@dataclass(frozen=True, slots=True)
class Batch:
    """Sessions that are written together.

    Attributes:
        sessions: in the order of time.
        path, recipe, text: of the recipe.
        schema: that all of them have.
    """

    sessions: list[Described]
    path: Path
    recipe: Recipe
    text: bytes
    schema: Schema


def write_batch(root: Path, new: Batch, so_far: SetSoFar, do: Runner, known: Sequence[Group] = ()) -> Exported:
    """Write sessions into a folder with the files of the data set before, if there was one.

    ``known`` are the groups that have a split already.  Raises as `export_sessions`.
    """
    recipe = new.recipe
    groups = groups_of(new.sessions, recipe, known)
    splits = splits_of_groups(new.sessions, groups, recipe, known)
    rank = {name: number for number, name in enumerate(recipe.splits or ())}
    sessions = sorted(new.sessions, key=lambda each: (rank.get(splits[each.path], 0), *each.order))
    parts = write_parts(root, sessions, groups, splits, new.path, new.schema, so_far, do)
    assemble(root, recipe, new.text, new.schema, so_far, parts)
    shutil.rmtree(root / _PARTS)
    files = sum(each.is_file() for each in root.rglob("*"))
    return Exported(recipe, parts, so_far, split_ranges(parts, so_far), files)


def describe(
    paths: Sequence[Path], recipe_path: Path, recipe: Recipe, do: Runner, known: Mapping[str, str] | None = None
) -> list[Described]:
    """Return the descriptions of sessions in the order of time.

    ``known`` has SHA-256 → name of the sessions in the data set.  Raises ConfigError for one that comes twice, is there
    already or does not fit, GatewayError.
    """
    if has_ranges(recipe.splits) and len(paths) > 1:
        name, value = next(iter((recipe.splits or {}).items()))
        raise ConfigError(
            f"splits.{name}: found {value!r}, a range of demonstrations, with {len(paths)} sessions, expected shares "
            'such as 0.8, or names of sessions or patients such as ["P01", "P02"]'
        )
    jobs = [Job(DESCRIBE, str(path.absolute()), str(recipe_path.absolute())) for path in paths]
    found = sorted((Described.of(each) for each in _replies(jobs, do)), key=lambda each: (*each.order, each.path))
    owners: dict[str, Described] = {}
    for each in found:
        other = owners.setdefault(each.sha256, each)
        if other is not each:
            raise ConfigError(
                f"found {printable(each.path)} twice, expected each session once"
                if each.path == other.path
                else f"found the content of {printable(other.path)} in {printable(each.path)}, too, expected each "
                "session once"
            )
    names = zip(found, distinct_names([each.path for each in found]), strict=True)
    if there := [_known(each, name, known[each.sha256]) for each, name in names if known and each.sha256 in known]:
        raise ConfigError(
            f"the data set has {count_text(len(there), 'of these sessions', 'of these sessions')} already: "
            f"{_few(there)}; expected others"
        )
    return found


def _known(session: Described, name: str, known: str) -> str:
    return name if session.name == known else f"{name}, there as {known}"


def distinct_names(paths: Sequence[str]) -> list[str]:
    """Return the names of recordings; if some have one name, with as many folders as make them differ."""
    parts = [Path(path).parts for path in paths]
    for count in range(1, max(map(len, parts))):
        names = [str(Path(*each[-count:])) for each in parts]
        if len(set(names)) == len(set(paths)):
            return names
    return list(paths)


def _replies(jobs: Sequence[Job], do: Runner) -> list[Mapping[str, Any]]:
    """The replies in the order of the jobs.  Raises an error that names all sessions without one."""
    found: dict[int, Reply] = dict(do(jobs))
    failed = {number: reply.error for number, reply in sorted(found.items()) if reply.error is not None}
    if not failed:
        return [found[number].value for number in range(len(jobs))]
    if len(jobs) == 1:
        raise next(iter(failed.values()))
    for error in failed.values():
        if isinstance(error, OSError):
            raise error
    names, texts = distinct_names([each.path for each in jobs]), []
    for number, error in failed.items():
        place = jobs[number].path
        texts.append(f"{printable(names[number])}: {str(error).replace(f'{place}: ', '')}")
    raise _together(len(jobs), texts, is_config=any(isinstance(each, ConfigError) for each in failed.values()))


def _together(count: int, texts: Sequence[str], *, is_config: bool = True) -> GatewayError:
    more = f"; and {len(texts) - _MOST:,} more" if len(texts) > _MOST else ""
    which = "" if count == 1 else f"{len(texts):,} of {count_text(count, 'session')} do not fit: "
    text = f"{which}{'; '.join(texts[:_MOST])}{more}"
    return ConfigError(text) if is_config else GatewayError(text)


def check_schema(sessions: Sequence[Described], schema: Schema, recipe: Recipe) -> None:
    """Raise ConfigError for sessions that differ from a schema, GatewayError for too many frames."""
    texts = []
    for each, name in zip(sessions, distinct_names([each.path for each in sessions]), strict=True):
        if found := differences(each, schema, recipe):
            more = f" and {len(found) - 1:,} more" if len(found) > 1 else ""
            texts.append(f"{printable(name)}: {found[0]}{more}")
    if texts:
        raise _together(len(sessions), texts)


def groups_of(sessions: Sequence[Described], recipe: Recipe, known: Sequence[Group] = ()) -> dict[str, str]:
    """Return the path of each session → its group.  Raises ConfigError for two sessions of one name."""
    found = {each.path: group_of(each.path, recipe.patient) for each in sessions}
    if not recipe.patient and recipe.splits:
        there = {each.name for each in known}
        for each in sessions:
            if found[each.path] in there:
                raise ConfigError(
                    f"splits: found another session {printable(found[each.path])!r} in the data set, expected "
                    "different names of sessions"
                )
            twice = [path for path, group in found.items() if group == found[each.path]]
            if len(twice) > 1:
                raise ConfigError(
                    f"splits: found {' and '.join(map(printable, twice[:2]))}, expected different names of sessions, "
                    'or splits.patient = "{patient}/*" if the folder is the patient'
                )
    return found


def splits_of_groups(
    sessions: Sequence[Described], groups: Mapping[str, str], recipe: Recipe, known: Sequence[Group] = ()
) -> dict[str, str]:
    """Return the path of each session → its split, "" for ranges of demonstrations.

    Args:
        sessions: in the order of time.
        groups: path → group.
        recipe: of the set.
        known: groups that have a split already, and keep it.

    Raises ConfigError for a group in no split or in two, and for a name that no group has.
    """
    if has_ranges(recipe.splits):
        return {each.path: "" for each in sessions}
    check_kept(recipe.splits, known)
    kept = {each.name: each.split for each in known}
    frames = {each.name: each.frames for each in known}
    for each in sessions:
        name = groups[each.path]
        frames[name] = frames.get(name, 0) + each.frames
    splits = assigned(recipe.splits, [Group(name, number, kept.get(name, "")) for name, number in frames.items()])
    if unused := unused_names(recipe.splits, list(frames)):
        raise ConfigError(f"{unused[0]}: found no session or patient of this name, expected one of {_few(frames)}")
    return {each.path: splits[groups[each.path]] for each in sessions}


def _few(names: Iterable[str]) -> str:
    return few_text(map(printable, names), _MOST)


def write_parts(
    root: Path,
    sessions: Sequence[Described],
    groups: Mapping[str, str],
    splits: Mapping[str, str],
    recipe_path: Path,
    schema: Schema,
    so_far: SetSoFar,
    do: Runner,
) -> list[Part]:
    """Write the parts of sessions into a folder of the data set, and return them.

    ``so_far.tasks`` gets their tasks.  Raises GatewayError, OSError.
    """
    folder, episode, frame = root / _PARTS, so_far.episodes, so_far.frames
    check_limit("count", episode + sum(len(each.episodes) for each in sessions), "episodes of the data set")
    if frame + sum(each.frames for each in sessions) > MAX_FRAMES:
        raise GatewayError(f"found more than {MAX_FRAMES:,} frames in all sessions, expected fewer")
    make_folder(folder)
    so_far.tasks = list(dict.fromkeys([*so_far.tasks, *(task for each in sessions for _, task in each.episodes)]))
    jobs = []
    for number, each in enumerate(sessions):
        place = Place(episode, frame, tuple(so_far.tasks), schema.names)
        part = str((folder / f"{number:06d}").absolute())
        jobs.append(Job(WRITE, each.path, str(recipe_path.absolute()), part, place))
        episode, frame = episode + len(each.episodes), frame + each.frames
    replies = _replies(jobs, do)
    for each, reply in zip(sessions, replies, strict=True):
        if schema.unlike(reply["features"]):
            raise GatewayError(
                f"{printable(each.name)}: it changed while it was read, expected a recording that is complete"
            )
    return [
        Part(each, groups[each.path], splits[each.path], Path(job.part), reply)
        for each, job, reply in zip(sessions, jobs, replies, strict=True)
    ]
