"""The two jobs of a session in a data set: to describe it, and to write its part, both with JSON in and out.

A job may run in this process, in a program of its own or on another machine, which finds recordings, recipe and data
set at the same paths.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from igtl_gateway.addon import NS_PER_S
from igtl_gateway.addon.reading import Recording, open_recording
from igtl_gateway.addon.untrusted import open_file
from igtl_gateway.addons.lerobot.card import approach, spaces, synchronization, unaligned
from igtl_gateway.addons.lerobot.card_streams import Facts, stream_facts
from igtl_gateway.addons.lerobot.frames import Place, Plan, build
from igtl_gateway.addons.lerobot.native import write_native
from igtl_gateway.addons.lerobot.recipe import Recipe
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.lerobot.samples import Samples
from igtl_gateway.addons.lerobot.schema import LEAST_SAMPLES, Described, RowFacts
from igtl_gateway.addons.lerobot.writing import facts_of, write_part

DESCRIBE, WRITE = "describe", "write"
#: Bytes that are hashed at a time.
_HASHED = 1 << 20


@dataclass(frozen=True, slots=True)
class Job:
    """What is done with a session.

    Attributes:
        kind: ``describe`` or ``write``.
        path: of the recording.
        recipe: of the data set.
        part: folder of the part, for ``write``.
        place: where the session is in the data set, for ``write``.
    """

    kind: str
    path: str
    recipe: str
    part: str = ""
    place: Place = field(default_factory=Place)

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON."""
        place = self.place
        names = [[row, list(each)] for row, each in place.names.items()]
        numbers = {"episode": place.episode, "frame": place.frame, "tasks": list(place.tasks), "names": names}
        return {"kind": self.kind, "path": self.path, "recipe": self.recipe, "part": self.part, "place": numbers}

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> Job:
        """Return the job that ``to_dict`` made a dictionary of."""
        place = value["place"]
        names = {int(row): tuple(each) for row, each in place["names"]}
        where = Place(place["episode"], place["frame"], tuple(place["tasks"]), names)
        return cls(value["kind"], value["path"], value["recipe"], value["part"], where)


def run_job(value: Mapping[str, Any]) -> dict[str, Any]:
    """Do a job and return its reply.

    Raises:
        ConfigError: the recipe and the recording do not fit.
        GatewayError: the recording cannot be read, or has no frame.
        OSError: the part cannot be written.
    """
    job = Job.of(value)
    path, recipe = Path(job.path), read_recipe(Path(job.recipe))
    with open_recording(path) as recording:
        if job.kind == DESCRIBE:
            return described(path, recipe, recording, build(recording, recipe)).to_dict()
        part = Path(job.part)
        # a job whose program is killed is done again, perhaps beside the first: each has a folder of its own
        trial = Path(mkdtemp(dir=part.parent, prefix=f"{part.name}-")) / part.name
        written = written_part(recording, build(recording, recipe, job.place), trial, shown_name(path, recipe.patient))
    try:
        os.rename(trial, part)
    except OSError:
        if not part.is_dir():  # otherwise another one has written the same
            raise
    return written


def described(path: Path, recipe: Recipe, recording: Recording, plan: Plan) -> Described:
    """Return the description of a session."""
    rows = (_row(number, each, recipe) for number, each in enumerate(plan.samples) if each is not None)
    episodes = tuple((each.count, each.task) for each in plan.episodes)
    name, start_ns = shown_name(path, recipe.patient), recording.start_time
    return Described(
        str(path), name, content_digest(path), start_ns, plan.clock, facts_of(plan).features, tuple(rows), episodes,
        plan.splits,
    )  # fmt: skip


def _row(number: int, samples: Samples, recipe: Recipe) -> RowFacts:
    row, pictures = samples.row, samples.pictures
    # strings, and numbers without a tolerance, come when something happens
    has_rate = samples.kind != "text" and row.tolerance_ms is not None and len(samples.times) >= LEAST_SAMPLES
    rate_hz = NS_PER_S / float(np.median(np.diff(samples.times))) if has_rate else 0.0
    size = pictures.size if pictures else ()
    names = () if samples.kind == "text" else samples.recorded_names
    return RowFacts(number, row.name, row.stream, samples.type, names, samples.units, size, rate_hz)


def written_part(recording: Recording, plan: Plan, part: Path, name: str) -> dict[str, Any]:
    """Write the part of a session, and return what is known about it."""
    streams = stream_facts(recording, plan)
    written = write_part(plan, part, synchronization(plan, streams, name))
    write_native(recording, plan, part)
    return written | {
        "unaligned": sum(map(bool, unaligned(plan, streams))),
        "spaces": list(spaces(plan)),
        "approach": list(approach(plan.recipe, plan.clock)),
        "notes": list(plan.joined.notes),
        "clock": plan.clock,
        "left_out": plan.left_out,
        "demonstrations": plan.demonstrations,
        "empty": plan.empty,
        "owners": plan.owners,
        "streams": [_stream(each) for each in streams],
    }


def _stream(facts: Facts) -> dict[str, Any]:
    row, pictures = facts.samples.row, facts.samples.pictures
    return {
        "feature": row.name, "stream": row.stream, "rule": row.rule, "messages": facts.samples.count,
        "unusable": facts.samples.unusable, "used": facts.used, "interpolated": facts.interpolated, "held": facts.held,
        "native": row.native, "within": facts.within, "rate_hz": facts.rate_hz, "furthest_ms": facts.furthest_ms,
        "outside": pictures.outside / pictures.pixels if pictures and pictures.pixels else 0.0,
    }  # fmt: skip


def shown_name(path: Path, patient: str) -> str:
    """Return the name of a recording, with the folders of the pattern of patients, in which equal names differ.

    Bytes that are not UTF-8 are escaped.
    """
    parts = path.absolute().parts[-(patient.count("/") + 1) :]
    return "/".join(parts).encode("utf-8", "backslashreplace").decode()


def content_digest(path: Path) -> str:
    """Return the SHA-256 of a recording; of a folder, that of its files with their names, in order."""
    found = hashlib.sha256()
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    for file in files:
        if file != path:
            found.update(f"\0{file.relative_to(path).as_posix()}\0".encode("utf-8", "surrogateescape"))
        with open_file(file) as stream:
            while data := stream.read(_HASHED):
                found.update(data)
    return found.hexdigest()
