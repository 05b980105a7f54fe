"""The navigation program of the LEGO scenario: 3D Slicer's part, as an actor of OpenIGTLink.

It sends the MR head, the landmarks and the plan, watches the pen stop at the crosses, registers image and robot,
tests that at crosses of their own, sends the points to be drawn, and measures the line that the camera saw.

It repeats what the robot must receive (the registration, the last message) twice a second, as navigation
programs do that stream a transform: a ROS reader may come late.  Lengths are millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.wire import Message
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.point import POINT_DTYPE, Points
from igtl_gateway.wire.polydata import RGBA, Attribute, Cells, PolyData
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from igtl_gateway_lab.simulate import lego_terms as terms
from igtl_gateway_lab.simulate.actor import ActorProtocol, ActorReport, Publishes, Received
from igtl_gateway_lab.simulate.lego_sheet import (
    AT_LESION,
    CHECKS,
    HEIGHT_MM,
    LANDMARKS,
    LineError,
    line_error,
    on_sheet,
    strokes,
)
from igtl_gateway_lab.simulate.registration import (
    Registration,
    Rigid,
    distances,
    expected_fle,
    expected_tre,
    register,
    register_in_order,
    rms,
    stops,
)
from igtl_gateway_lab.simulate.star_numbers import Array
from igtl_gateway_lab.simulate.volume import MrVolume

_REPEAT_NS = 500 * NS_PER_MS
#: Since the beginning: the image, then what lies in it.
_IMAGE_NS, _LANDMARKS_NS, _PLAN_NS = 100 * NS_PER_MS, 700 * NS_PER_MS, 900 * NS_PER_MS

#: Slower than this for so long is a stop at a cross.
_SLOWEST_MM_S, _SHORTEST_S = 20.0, 0.5
_WINDOW_S = 0.25  #: no multiple of the robot's 50 ms, so that no sample is on its edge
#: Within these the toy has done its work.
MAX_FRE_MM, MAX_TRE_MM, MAX_LINE_MM = 2.0, 3.0, 4.0

_GREEN, _BLUE, _ORANGE, _RED = (60, 200, 90, 255), (70, 140, 255, 255), (255, 160, 40, 255), (235, 60, 50, 255)
_CROSS_MM, _DOT_MM = 4.0, 1.5
#: A first guess, from the marks on the table: the sheet lies straight in front of the robot.
_GUESS = Rigid(np.eye(3), np.array([210.0, 24.0, -HEIGHT_MM]))


class LegoPlanner:
    """The actor."""

    name = "planner"
    side = ActorProtocol.IGTL

    def __init__(self, volume: MrVolume) -> None:
        self.subscribes: dict[str, str] = {}
        self.publishes: dict[str, Publishes] = {}
        self._volume = volume
        self._crosses = on_sheet(LANDMARKS | CHECKS)
        self._plan = strokes()
        self._agenda: list[tuple[int, Message]] = []  # in order of time
        self._repeat_ns: int | None = None
        self._transform = _GUESS
        self._pen_ns: list[int] = []
        self._pen: list[tuple[float, ...]] = []
        self._registration: Registration | None = None
        self._checked: Array = np.empty(0)
        self._stops = 0
        self._asked = False
        self._segments: Array = np.empty((0, 2, 3))
        self._expected = -1  # segments that the robot reports as drawn
        self._line: LineError | None = None
        self._result = ""
        self._done = False

    # -- Actor --------------------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        names, groups = list(LANDMARKS | CHECKS), ["landmark"] * len(LANDMARKS) + ["check"] * len(CHECKS)
        colours = [_GREEN] * len(LANDMARKS) + [_BLUE] * len(CHECKS)
        landmarks = _points(self._crosses, names, groups, colours, _CROSS_MM)
        self._agenda = [
            (now_ns + _IMAGE_NS, self._message("IMAGE", terms.VOLUME, self._volume.image, now_ns + _IMAGE_NS)),
            (now_ns + _LANDMARKS_NS, self._message("POINT", terms.LANDMARKS, landmarks, now_ns + _LANDMARKS_NS)),
            (now_ns + _PLAN_NS, self._message("POLYDATA", terms.PLAN, _lines(self._plan), now_ns + _PLAN_NS)),
        ]
        self._repeat_ns = now_ns

    @property
    def due_ns(self) -> int | None:
        times = [time_ns for time_ns, _ in self._agenda[:1]]
        if self._repeat_ns is not None and not self._done:
            times.append(self._repeat_ns)
        return min(times, default=None)

    @property
    def done(self) -> bool:
        return self._done

    def act(self, now_ns: int) -> Iterable[Message]:
        while self._agenda and self._agenda[0][0] <= now_ns:
            yield self._agenda.pop(0)[1]
        if self._repeat_ns is not None and self._repeat_ns <= now_ns and not self._done:
            self._repeat_ns = now_ns + _REPEAT_NS
            yield self._message("TRANSFORM", terms.REGISTRATION, Transform.from_rows(self._transform.rows), now_ns)
            if self._result:
                yield self._message("STRING", terms.SAYS, String.of(self._result), now_ns)

    def receive(self, now_ns: int, received: Received) -> Iterable[Message]:
        if not isinstance(received, Message):
            return
        match received.device_name, received.content:
            case terms.PEN_DEVICE, Transform() as pose if not self._registration:
                self._pen_ns.append(ticks_to_ns(received.ticks))
                self._pen.append(pose.wire_matrix[9:])
            case terms.INK_DEVICE, PolyData() as ink:
                pairs = [pair for line in ink.lines.lists() for pair in pairwise(line)]
                self._segments = np.asarray(ink.points, np.float64)[np.array(pairs, np.int64).reshape(-1, 2)]
                yield from self._measured(now_ns)
            case terms.STATUS_DEVICE, String() as words:
                yield from self._on_text(words.text, now_ns)

    def report(self) -> ActorReport:
        facts: dict[str, Any] = {"volume": self._volume.source, "stops": self._stops}
        lines = [f"planning volume: {self._volume.source}, {' × '.join(map(str, self._volume.size))} voxels"]
        if self._registration:
            found, checked = self._registration, self._checked
            residuals = dict(zip(LANDMARKS, np.round(found.residuals, 2).tolist(), strict=True))
            worst = max(residuals, key=lambda name: residuals[name])
            lesion = self._crosses[list(LANDMARKS | CHECKS).index(AT_LESION)]
            expected = expected_tre(self._crosses[: len(LANDMARKS)], found.fre, lesion)
            # a check point is touched no better than a landmark
            check_mm = math.hypot(expected, expected_fle(len(LANDMARKS), found.fre))
            facts |= {
                "fre_mm": round(found.fre, 3),
                "residuals_mm": residuals,
                "tre_mm": round(rms(checked), 3),
                "checks_mm": dict(zip(CHECKS, np.round(checked, 2).tolist(), strict=True)),
                "expected_tre_mm": round(expected, 3),
                "expected_check_mm": round(check_mm, 3),
                "transform": [[round(value, 4) for value in row] for row in found.transform.rows],
            }
            lines += [
                f"registration: {len(LANDMARKS)} landmarks, FRE {found.fre:.2f} mm, "
                f"worst {worst} {residuals[worst]:.2f} mm",
                f"TRE at {len(CHECKS)} check points {rms(checked):.2f} mm (rms), largest {checked.max():.2f} mm",
                f"expected at the lesion: TRE {expected:.2f} mm, and {check_mm:.2f} mm with the error of touching it",
            ]
        if self._line:
            line = self._line
            facts["line_mm"] = {name: round(getattr(line, name), 3) for name in LineError.__slots__}
            lines.append(
                f"line: {line.planned:.0f} mm planned, {line.drawn:.0f} mm drawn; off by {line.mean:.2f} mm (mean), "
                f"{line.largest:.2f} mm (largest), Hausdorff {line.hausdorff:.2f} mm"
            )
        if self._result and not self._line:
            lines.append(self._result)
        return ActorReport(self._done and self._good, tuple(lines), facts)

    @property
    def _good(self) -> bool:
        return (
            self._registration is not None
            and self._line is not None
            and self._registration.fre <= MAX_FRE_MM
            and bool(self._checked.max() <= MAX_TRE_MM)
            and self._line.hausdorff <= MAX_LINE_MM
        )

    # -- Reports of the robot ------------------------------------------------------------------------------------------

    def _on_text(self, text: str, now_ns: int) -> Iterator[Message]:
        word, _, rest = text.partition(" ")
        number = int(first) if (first := rest.split(" ")[0]).isdecimal() else 0
        if word == terms.TOUCHED_ALL and not self._registration:
            yield from self._register(now_ns)
        elif word == terms.REGISTERED and self._registration and not self._asked:
            self._asked = True
            yield self._message("POINT", terms.POINTS, _stroke_points(self._plan), now_ns)
        elif word == terms.DRAWN:
            self._expected = number
            yield from self._measured(now_ns)
        elif text.startswith(terms.REFUSED):
            yield from self._conclude(f"the robot {text}", now_ns)
        elif word == terms.FINISHED:
            self._done = True

    def _register(self, now_ns: int) -> Iterator[Message]:
        """From where the pen has stood to the crosses; those of the checks take no part."""
        times_s = [(stamp_ns - self._pen_ns[0]) / NS_PER_S for stamp_ns in self._pen_ns]
        found = stops(
            np.array(times_s), np.array(self._pen), slowest=_SLOWEST_MM_S, shortest_s=_SHORTEST_S, window_s=_WINDOW_S
        )
        self._stops = len(found)
        try:
            places = np.array([stop.position for stop in found]).reshape(-1, 3)
            _, first = register_in_order(self._crosses, places)
            touched, count = places[first : first + len(self._crosses)], len(LANDMARKS)
            registration = register(self._crosses[:count], touched[:count])
            if registration.transform.rotation[2, 2] < 0:
                # of crosses in one plane a mirror image fits as well as they do, turned over: the FRE is the same
                raise ConfigError("registration: found the sheet face down, expected face up; left taken for right?")
        except ConfigError as error:
            yield from self._conclude(str(error), now_ns)
            return
        self._registration, self._transform = registration, registration.transform
        off = distances(self._transform.apply(self._crosses), touched)
        self._checked = off[count:]
        colours = [_GREEN if error <= 1 else _ORANGE if error <= MAX_FRE_MM else _RED for error in off.tolist()]
        names = [""] * len(off)  # the crosses beside them have names
        back = self._transform.inverse().apply(touched)
        yield self._message("TRANSFORM", terms.REGISTRATION, Transform.from_rows(self._transform.rows), now_ns)
        yield self._message(
            "POINT", terms.TOUCHED, _points(back, names, ["touched"] * len(names), colours, _DOT_MM), now_ns
        )
        each = ", ".join(f"{name} {error:.1f}" for name, error in zip(LANDMARKS | CHECKS, off.tolist(), strict=True))
        text = f"registered: FRE {registration.fre:.2f} mm, TRE {rms(self._checked):.2f} mm ({each})"
        yield self._message("STRING", terms.SAYS, String.of(text), now_ns)

    def _measured(self, now_ns: int) -> Iterator[Message]:
        """The line, once both have come: that it is drawn, and all of it."""
        if self._result or self._expected < 0 or len(self._segments) != self._expected:
            return
        if not self._expected:
            yield from self._conclude("nothing was drawn", now_ns)
            return
        self._line = line_error(list(self._plan.values()), self._segments)
        line = self._line
        yield from self._conclude(f"line off by {line.mean:.2f} mm (mean), {line.largest:.2f} mm (largest)", now_ns)

    def _conclude(self, text: str, now_ns: int) -> Iterator[Message]:
        self._result = f"{terms.RESULT}: {text}"
        yield self._message("STRING", terms.SAYS, String.of(self._result), now_ns)

    @staticmethod
    def _message(kind: str, device: str, content: Body, now_ns: int) -> Message:
        return Message(kind, device, content, ns_to_ticks(now_ns))


def _points(
    positions: Array, names: list[str], groups: list[str], colours: Sequence[tuple[int, ...]], size_mm: float
) -> Points:
    elements = np.zeros(len(positions), POINT_DTYPE)
    elements["name"] = [name.encode() for name in names]
    elements["group"] = [group.encode() for group in groups]
    elements["rgba"] = colours
    elements["position"] = positions
    elements["diameter"] = size_mm
    elements["owner"] = terms.VOLUME.encode()
    return Points(elements)


def _stroke_points(plan: dict[str, Array]) -> Points:
    names = [f"{name} {number}" for name, line in plan.items() for number in range(1, len(line) + 1)]
    groups = [name for name, line in plan.items() for _ in line]
    return _points(np.concatenate(list(plan.values())), names, groups, [_ORANGE] * len(names), _DOT_MM)


def _lines(plan: dict[str, Array]) -> PolyData:
    points = np.concatenate(list(plan.values()))
    ends = np.cumsum([len(line) for line in plan.values()]).tolist()
    cells = [list(range(end - len(line), end)) for line, end in zip(plan.values(), ends, strict=True)]
    colours = np.tile(np.array(_ORANGE) / 255, (len(points), 1))
    colour = Attribute.of(RGBA, "Colors", colours)
    return PolyData(points.astype(">f4"), lines=Cells.of(cells), attributes=(colour,))
