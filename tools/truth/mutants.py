"""Faults that the judge must find: each is planted in what the product is given or in what it wrote.

The truth stays that of the unchanged world.  A mutant that no fault of the judge answers shows that the judge is blind.
"""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from tools.truth import senders, wire, world
from tools.truth.conditions import plan_of
from tools.truth.files import make
from tools.truth.judges import files as readers
from tools.truth.judges.truth import LOST, NAME, PAIR, TIME, VALUE, Truth
from tools.truth.routes import Case
from tools.truth.senders import MS, Plan, Stream
from tools.truth.table import SILENT, Verdict, judge


def _by_receipt() -> AbstractContextManager[Any]:
    """Each frame of a sequence has the poses of the frame before, as if they were paired by the order of receipt."""
    read = readers.by_itk

    def shifted(path: Path) -> Iterator[Any]:
        frames = list(read(path))
        for (reference, _), (_, others) in zip(frames[1:], frames, strict=False):
            yield reference, others

    return patch.object(readers, "by_itk", shifted)


def _body(kind: str, changed: Callable[[Stream, int, int, random.Random], bytes]) -> AbstractContextManager[Any]:
    return patch.dict(senders._BODIES, {kind: changed})


def _transform(change: Callable[[Any], Any]) -> AbstractContextManager[Any]:
    def send(stream: Stream, true_ns: int, stamp_ns: int, _: random.Random) -> bytes:
        matrix = change(world.pose(stream.things[0], true_ns / 1e9))
        return senders._peer("TRANSFORM", stream, stamp_ns, wire.transform(matrix))

    return _body("transform", send)


def _metres(matrix: Any) -> Any:
    matrix[:3, 3] /= 1000
    return matrix


def _transposed(matrix: Any) -> Any:
    matrix[:3, :3] = matrix[:3, :3].T.copy()
    return matrix


def _positioned() -> AbstractContextManager[Any]:
    """The angles of the joints are in the order of another list than their names."""
    joints = world.joints

    def turned(arm: int, count: int, at: float) -> Any:
        return np.roll(joints(arm, count, at), 1)

    return patch.object(world, "joints", turned)


def _late(plan: Plan) -> None:
    for sender in plan.senders:
        sender.offset_ns += 100 * MS


def _swapped(plan: Plan) -> None:
    one, two = plan.streams[:2]
    one.key, two.key = two.key, one.key


def _without_images(plan: Plan) -> None:
    plan.streams = [stream for stream in plan.streams if stream.kind != "image"]


@dataclass(frozen=True)
class Mutant:
    """A planted fault.

    Attributes:
        route, kind: where it is looked for, and the kind of fault that has to be found.
        plan: changes the plan that is recorded.
        making, reading: in force while the file is made, and while the route is judged.
    """

    route: str
    kind: str
    plan: Callable[[Plan], None] = lambda plan: None
    making: Callable[[], AbstractContextManager[Any]] = nullcontext
    reading: Callable[[], AbstractContextManager[Any]] = nullcontext


_FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])

#: Name of a mutant → what it is.
MUTANTS: dict[str, Mutant] = {
    "pairing by order of receipt": Mutant("igs.mha", PAIR, reading=_by_receipt),
    "stamps off by 100 ms": Mutant("csv", TIME, plan=_late),
    "joints by position": Mutant("parquet", NAME, making=_positioned),
    "swapped names": Mutant("python", NAME, plan=_swapped),
    "LPS for RAS": Mutant("rosbag2", VALUE, making=lambda: _transform(lambda matrix: _FLIP @ matrix)),
    "m for mm": Mutant("view", VALUE, making=lambda: _transform(_metres)),
    "rotation transposed": Mutant("csv", VALUE, making=lambda: _transform(_transposed)),
    "a stream is missing": Mutant("nrrd", LOST, plan=_without_images),
    "joints by position, as a data set": Mutant("lerobot_samples", NAME, making=_positioned),
    "LPS for RAS, appended": Mutant("lerobot_append", VALUE, making=lambda: _transform(lambda matrix: _FLIP @ matrix)),
    "m for mm, imported": Mutant("lerobot_import", VALUE, making=lambda: _transform(_metres)),
    "stamps off by 100 ms, as a feature": Mutant("lerobot_stamps", TIME, plan=_late),
}


def judged(name: str, seed: int = 0) -> Verdict:
    """What the judge makes of a mutant of an ordinary world."""
    mutant, plan, changed = MUTANTS[name], plan_of(seed, []), plan_of(seed, [])
    mutant.plan(changed)
    with tempfile.TemporaryDirectory(prefix="truth-") as folder:
        with mutant.making():
            recording = make(changed, Path(folder))
        with mutant.reading():
            return judge(Case(plan, recording, Truth(plan, recording), Path(folder)), mutant.route)


def is_found(name: str) -> bool:
    """Whether the judge finds a mutant, as a fault of its kind."""
    verdict = judged(name)
    return verdict.verdict == SILENT and any(text.startswith(MUTANTS[name].kind) for text in verdict.lines)
