"""``--append``: sessions are added to a data set, which is replaced at one moment by a folder that has both.

The new folder has links to the files of the old one; what changes is written again (``assembling``).  So the cost is
that of the new sessions, and the old set is whole until the exchange.  A set that another program began is extended if
its features are those of the recipe; what is unknown in its metadata stays.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from igtl_gateway.addon import ConfigError, DamagedRecording, UnsupportedRecording
from igtl_gateway.addon.untrusted import check_limit, open_file, printable, read_bytes, read_parquet_schema
from igtl_gateway.addon.writing import make_folder, open_new, replaced_folder
from igtl_gateway.addons.lerobot.assembling import SetSoFar
from igtl_gateway.addons.lerobot.checksums import read_checksums
from igtl_gateway.addons.lerobot.export import Batch, Exported, Runner, check_schema, describe, here, write_batch
from igtl_gateway.addons.lerobot.layout import CHUNK
from igtl_gateway.addons.lerobot.native import NATIVE
from igtl_gateway.addons.lerobot.reading import read_data_set, read_info, read_tasks, read_total_stats
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.schema import Described, RowFacts, Schema, flat_names, schema_of
from igtl_gateway.addons.lerobot.session_list import SESSIONS, SessionList, read_session_list
from igtl_gateway.addons.lerobot.splits import Group, has_ranges, owners_of, ranges_of
from igtl_gateway.addons.lerobot.writing import PROVENANCE, RECIPE

#: What may differ from the recipe of the set: no frame depends on it.
_MAY_DIFFER = ("splits", "card", "rates", "measure_lags")
_NUMBERS = re.compile(r"chunk-([0-9]{3,18})/file-([0-9]{3})\.(?:parquet|mp4)")
#: Files that no later session changes.
_KEPT = re.compile(rf"data/.*|videos/.*|meta/(?:episodes|{NATIVE})/.*|meta/provenance[^/]*")


@dataclass(frozen=True, slots=True)
class _Old:
    """A data set before sessions are added.

    Attributes:
        so_far: what it has.
        groups: those of its sessions; of episodes of another program one for each split.
        recipe: of the set; None if it has none.
    """

    so_far: SetSoFar
    groups: Sequence[Group]
    recipe: Path | None


def append_sessions(paths: Sequence[Path], recipe_path: Path | None, out: Path, do: Runner = here) -> Exported:
    """Add sessions to a data set, which is as before if that fails.

    Args:
        paths: of the recordings, in any order.
        recipe_path: of a recipe with the frames of that of the set; None: that of the set.
        out: the directory of the set, or a link to it.
        do: runs the jobs of the sessions.

    Raises as ``export_sessions``, and GatewayError for a set that is not whole, or that another program writes to.
    """
    root = out.resolve() if out.is_symlink() or out.name in ("", "..") else out
    with replaced_folder(root) as folder:
        old = _read(root)
        path = recipe_path or old.recipe
        if path is None:
            raise ConfigError(f"{root}: found no meta/{RECIPE} in it, expected the recipe of the sessions by --recipe")
        recipe, text = read_recipe(path), read_bytes(path)
        _check_recipe(recipe, path, old, root)
        listed = old.so_far.sessions
        sessions = describe(paths, path, recipe, do, {each.sha256: each.name for each in listed.sessions})
        schema = _schema(sessions, old.so_far, root)
        check_schema(sessions, schema, recipe)
        _link(root, folder)
        done = write_batch(folder, Batch(sessions, path, recipe, text, schema), old.so_far, do, old.groups)
        _keep_modes(root, folder)
    return done


def _read(root: Path) -> _Old:
    """Read what a set has.  Raises GatewayError unless it is whole, as far as its metadata state."""
    if not (root / "meta" / "info.json").is_file():
        raise ConfigError(
            f"{root}: found no meta/info.json in it, expected a data set; without --append it is a new one"
        )
    info, listed = read_info(root), read_session_list(root)
    check_limit("count", info["total_episodes"], f"{root}/meta/info.json: episodes")
    tasks = read_tasks(root, info["codebase_version"])
    if len(tasks) != info["total_tasks"] or sorted(tasks) != list(range(len(tasks))):
        raise DamagedRecording(f"{root}/meta: found other tasks than info.json, expected {info['total_tasks']:,}")
    splits = owners_of(info["splits"], info["total_episodes"])
    if "" in splits or ranges_of(splits) != info["splits"]:
        raise DamagedRecording(
            f"{root}/meta/info.json: splits: found {_short(info['splits'])}, expected each episode once"
        )
    if listed is None:
        listed, sums = _others(root, info), {}
    else:
        sums = {name: digest for name, digest in read_checksums(root).items() if _KEPT.fullmatch(name)}
    _check_sessions(root, info, listed, splits)
    so_far = SetSoFar(
        listed, [tasks[number] for number in sorted(tasks)], info["total_episodes"], info["total_frames"], splits,
        info=info, checksums=sums,
    )  # fmt: skip
    if info["codebase_version"] == "v3.0":
        so_far.stats = read_total_stats(root)
        so_far.data_files = _next(root / "data")
        so_far.video_files = {name: _next(root / "videos" / name) for name in info["features"]}
        so_far.episode_files = _next(root / "meta" / "episodes")
        so_far.episode_schema = read_parquet_schema(min((root / "meta" / "episodes").glob("chunk-*/file-*.parquet")))
    recipe = root / "meta" / RECIPE
    return _Old(so_far, _groups(so_far), recipe if recipe.is_file() else None)


def _others(root: Path, info: Mapping[str, Any]) -> SessionList:
    """The list of the sessions of a set of another program: none.  Raises GatewayError unless the set is whole."""
    for name in (RECIPE, PROVENANCE):
        if (root / "meta" / name).exists():
            raise UnsupportedRecording(
                f"{root}: found meta/{name} without meta/{SESSIONS}, a set of an older igtl-gateway: export it again"
            )
    if info.get("chunks_size", CHUNK) != CHUNK:
        raise UnsupportedRecording(f"{root}/meta/info.json: chunks_size: found {info['chunks_size']}, expected {CHUNK}")
    found = read_data_set(root)
    if [each.index for each in found.episodes] != list(range(info["total_episodes"])) or not found.episodes:
        raise DamagedRecording(
            f"{root}/meta: found other episodes than in info.json, expected {info['total_episodes']}"
        )
    if sum(each.length for each in found.episodes) != info["total_frames"]:
        raise DamagedRecording(f"{root}/meta: found other frames than in info.json, expected {info['total_frames']:,}")
    files = {path for each in found.episodes for path in (each.data, *(part.path for part in each.videos.values()))}
    for path in sorted(files):
        if not path.is_file():
            raise DamagedRecording(f"{path}: found no file, which episodes of the data set have, expected a whole set")
    for folder in ("data", "videos"):
        more = {path for path in (root / folder).rglob("*") if path.is_file()} - files
        if more:
            raise DamagedRecording(
                f"{min(more)}: found a file of no episode, expected none: its name may be that of the next"
            )
    return SessionList(others=len(found.episodes))


def _check_sessions(root: Path, info: Mapping[str, Any], listed: SessionList, splits: Sequence[str]) -> None:
    """Raise DamagedRecording unless the list of the sessions is that of the episodes."""
    episode, others = listed.others, info["total_episodes"] - sum(each.episodes for each in listed.sessions)
    frames = info["total_frames"] - sum(each.frames for each in listed.sessions)
    if others != listed.others or (others == 0) != (frames == 0) or frames < 0:
        raise DamagedRecording(
            f"{root}/meta/{SESSIONS}: found other episodes than in info.json, expected the same: see --check"
        )
    for each in listed.sessions:
        if each.split and set(splits[episode : episode + each.episodes]) - {each.split}:
            raise DamagedRecording(
                f"{root}/meta/info.json: splits: found {printable(each.name)} not in {each.split}, expected the "
                f"splits of meta/{SESSIONS}"
            )
        episode += each.episodes


def _groups(so_far: SetSoFar) -> list[Group]:
    found: dict[str, Group] = {}
    listed = so_far.sessions
    for each in listed.sessions:
        before = found.get(each.group, Group(each.group, 0, each.split))
        found[each.group] = replace(before, frames=before.frames + each.frames)
    frames = so_far.frames - sum(each.frames for each in listed.sessions)
    splits = so_far.splits[: listed.others]
    return [
        *found.values(),
        # a name that no session has
        *(Group(f"\0{name}", frames * splits.count(name) // listed.others, name) for name in dict.fromkeys(splits)),
    ]


def _next(folder: Path) -> int:
    """The number after that of the last file of v3.0 in a folder."""
    names = (path.relative_to(folder).as_posix() for path in folder.glob("chunk-*/file-*"))
    found = filter(None, map(_NUMBERS.fullmatch, names))
    return max((int(each[1]) * CHUNK + int(each[2]) + 1 for each in found), default=0)


def _check_recipe(recipe: Recipe, path: Path, old: _Old, root: Path) -> None:
    """Raise ConfigError for a recipe that makes other frames than those of the set."""
    if has_ranges(recipe.splits):
        name, value = next(iter((recipe.splits or {}).items()))
        raise ConfigError(
            f"{path}: splits.{name}: found {value!r}, a range of demonstrations of one session, expected shares or "
            "names"
        )
    if old.recipe is not None:
        own = read_recipe(old.recipe)
        if has_ranges(own.splits):
            raise ConfigError(
                f"{old.recipe}: splits: found ranges of demonstrations of one session, expected a set of many"
            )
        pairs = [(each.name, getattr(recipe, each.name), getattr(own, each.name)) for each in fields(Recipe)]
    else:
        info = old.so_far.info
        pairs = [
            ("fps", recipe.fps, info["fps"]),
            ("format", recipe.format, info["codebase_version"]),
            ("robot_type", recipe.robot_type, info.get("robot_type") or recipe.robot_type),
        ]
    for name, found, expected in pairs:
        if found != expected and name not in _MAY_DIFFER:
            if name == "features":
                rows = [number for number, pair in enumerate(zip(found, expected, strict=False)) if pair[0] != pair[1]]
                place = f"feature[{(rows or [min(len(found), len(expected))])[0]}]"
                raise ConfigError(f"{path}: {place}: found another row, expected that of {root}")
            place = {"patient": "splits.patient", "episodes": "episodes"}.get(name, f"dataset.{name}")
            raise ConfigError(f"{path}: {place}: found {_short(found)}, expected {_short(expected)} as in {root}")


def _short(value: Any) -> str:
    text = repr(value)
    return printable(text if len(text) <= 60 else f"{text[:60]}…")


def _schema(sessions: Sequence[Described], so_far: SetSoFar, root: Path) -> Schema:
    """What the new sessions must have.  Raises DamagedRecording for a list of sessions of another recipe."""
    listed, own = so_far.sessions, schema_of(sessions)
    features = so_far.info["features"]
    if not listed.sessions:
        return replace(own, features=features, rows=tuple(_ordered(own.rows, features)), name=root.name, is_own=False)
    if [each.row for each in listed.rows] != [each.row for each in own.rows]:
        raise DamagedRecording(f"{root}/meta/{SESSIONS}: rows: found other rows than in the recipe, expected the same")
    return Schema(listed.clock, features, listed.rows, listed.sessions[0].name, not listed.others)


def _ordered(rows: Sequence[RowFacts], features: Mapping[str, Any]) -> Iterator[RowFacts]:
    """Rows whose names are in the order of features of another program, where a feature has one row and names."""
    count = Counter(each.feature for each in rows)
    for row in rows:
        names = flat_names(features.get(row.feature, {}).get("names"))
        is_other = (
            isinstance(names, list) and count[row.feature] == 1 and Counter(map(str, names)) == Counter(row.names)
        )
        yield replace(row, names=tuple(names)) if is_other else row


def _link(old: Path, new: Path) -> None:
    """Give a folder links to all files of another one; copies where the file system has no links.

    Raises UnsupportedRecording for links and what else is no file, OSError.
    """
    for place, folders, names in os.walk(old, onerror=_raise):
        target = new / Path(place).relative_to(old)
        for name in folders:
            if Path(place, name).is_symlink():
                raise UnsupportedRecording(f"{Path(place, name)}: found a link, expected a data set without links")
            make_folder(target / name)
        for name in names:
            path = Path(place, name)
            if not stat.S_ISREG(path.lstat().st_mode):
                raise UnsupportedRecording(f"{path}: found a link or a device, expected a data set of files: copy it")
            try:
                os.link(path, target / name)
            except OSError:
                with open_file(path) as source, open_new(target / name) as copy:
                    shutil.copyfileobj(source, copy)


def _raise(error: OSError) -> None:
    raise error


def _keep_modes(old: Path, new: Path) -> None:
    """Give what is new the modes of the set: who could read it, still can."""
    of_files, of_folders = (stat.S_IMODE((old / each).stat().st_mode) for each in ("meta/info.json", "meta"))
    for path in (new, *new.rglob("*")):
        before = old / path.relative_to(new)
        mode = of_folders if path.is_dir() else of_files
        with suppress(FileNotFoundError):
            mode = stat.S_IMODE(before.stat().st_mode)
        if stat.S_IMODE(path.stat().st_mode) != mode:
            path.chmod(mode)
