"""Random worlds between guard and robot: what subscribes, when, and what reaches it, by the stamps of its source.

A world has an arm with its states, a peer that commands it, and a middleware on manual time (``robot_middleware``).
Hub, core, guard and the publishing half of the edge are the real ones.  The judge subscribes as a robot does.  It knows
the limits, and nothing of the guard: it integrates what the readers got by the source stamps of the middleware.
"""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from igtl_gateway.app.bridge_options import BridgeOptions
from igtl_gateway.app.hub import Hub
from igtl_gateway.app.ros_traffic import RosTraffic
from igtl_gateway.app.subscriptions import Subscriptions
from igtl_gateway.base.buffers import join
from igtl_gateway.base.clock import ManualClock
from igtl_gateway.base.stamp import NS_PER_MS, NS_PER_S, ns_to_ticks
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.convert.common_msgs import JointState, PoseStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.ros.host import NodeHost
from igtl_gateway.gateway import LINK_UP, Gateway, Session
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.groups import input_groups
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.native.passage import Passage
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.sensor import Sensor
from igtl_gateway.wire.text import String
from igtl_gateway.wire.transform import Transform
from tests.app.robot_middleware import NEVER_NS, Got, Reader, Side, Wire, dds, simulated, zenoh

T0_NS = 1_790_000_000 * NS_PER_S
KINDS = ("dds", "dds", "dds of Humble", "zenoh")
#: A stream may begin this far from the arm, and be this far from it while it goes on: times at the limit.
_BEGIN_S, _BEHIND_S = 0.02, 0.2
_SETTLED_NS = 250 * NS_PER_MS
_KNOWN_NS = NS_PER_S
#: What float32 on the wire and the sums of the judge round, m or rad.
_NOTHING = 1e-7


class _Traffic(RosTraffic):
    """The ROS side of a bridge over an edge that is handed in."""

    made: Side

    def _make_side(self, host: NodeHost | None, passage: Passage | None) -> RosSide:
        side: Any = self.made
        return side


class RobotWorld:
    """One world of a seed.

    Args:
        seed: everything follows from it.
        recorded: as in a recorded session, all outputs are built.

    Attributes:
        kind: the middleware.
        readers: who subscribes to the commands; the first ones are the robot, one after the other.
        log: all entries of the session.
        sent: commands of the peer.
        codes: code of each note → how often.
    """

    def __init__(self, seed: int, *, recorded: bool) -> None:
        rng = random.Random(seed)
        self._recorded = recorded
        self.kind = rng.choice(KINDS)
        self.clock = ManualClock(T0_NS)
        self.wire = Wire(self.clock, random.Random(seed + 1), rng.choice((0.0, 0.0, 0.004, 0.03)))
        self.log: list[Entry] = []
        self.sent, self.codes = 0, Counter[str]()
        self._joints = rng.random() < 0.3
        self.speed = rng.choice((0.25, 0.25, 0.05, 1.0))
        self.max_age_s = rng.choice((0.5, 0.5, 0.1))
        self.device = "PSM1/servo_jp" if self._joints else "PSM1/servo_cp"
        limits = {"joint_speed": (self.speed,)} if self._joints else {"max_speed": self.speed}
        self.arms = ArmsRow("/PSM1", max_age_s=self.max_age_s, **limits)
        allowed = rng.choice((("PSM1/servo_*", "PSM1/state_*"), (self.device, "PSM1/state_command")))
        self.config = Config(profile="crtk", crtk=(self.arms,), allow_in=allowed).watched()
        self.lasts_ns = rng.randint(2_000, 5_000) * NS_PER_MS
        self.stopped_ns = T0_NS + rng.randint(1_500 * NS_PER_MS, self.lasts_ns)
        self.readers = self._some_readers(rng)
        self.wire.readers += self.readers
        self._arm_period_ns, self._arm_delay_ns = (
            rng.choice((5, 10, 20, 50)) * NS_PER_MS,
            rng.choice((0, 1, 8)) * NS_PER_MS,
        )
        self._follows = rng.choice(("exact", "exact", "exact", "late", "slow", "still"))
        self._silent_ns = T0_NS + rng.choice((10_000, 10_000, 10_000, 1_500)) * NS_PER_MS
        self._at = np.zeros(3)
        self.shown: list[tuple[int, np.ndarray[Any, Any]]] = []  # states as the gateway got them
        self._plan_commander(rng)
        self._start(rng)

    # -- who subscribes -----------------------------------------------------------------------------------------------

    def _some_readers(self, rng: random.Random) -> list[Reader]:
        """Return the robot, which may be late, leave and come back, and others that look at its commands."""
        topic = f"/{self.device}"

        def reader(since_ns: int, *, fits: bool = True, left_ns: int = NEVER_NS) -> Reader:
            foreign = self.kind != "zenoh" and rng.random() < 0.25
            writer_ns = since_ns + rng.choice((0, 1, 10, 100, 600)) * NS_PER_MS
            late_ms = rng.choice((0, 3, 100, 240)) if foreign else rng.choice((0, 0, 2, 20))
            reader_ns = writer_ns + (late_ms * NS_PER_MS if self.kind != "zenoh" else 0)
            deaf_ns = writer_ns + rng.randint(0, 2_000) * NS_PER_MS
            deaf = (deaf_ns, deaf_ns + rng.choice((20, 300, 900)) * NS_PER_MS) if rng.random() < 0.2 else (0, 0)
            return Reader(topic, since_ns, writer_ns, reader_ns, left_ns, fits, foreign, deaf)

        at_ns = T0_NS + rng.choice((0, 0, 50, 500, 1_500, 2_500)) * NS_PER_MS
        robots = []
        for _ in range(rng.choice((1, 1, 2, 3))):
            left_ns = at_ns + rng.randint(700, 1_500) * NS_PER_MS
            robots.append(reader(at_ns, left_ns=left_ns))
            at_ns = left_ns + rng.choice((0, 1, 15, 200, 800)) * NS_PER_MS
        robots[-1].left_ns = NEVER_NS
        self._robots = robots
        lookers = [
            reader(T0_NS + rng.randint(0, 3_000) * NS_PER_MS, fits=rng.random() < 0.4)
            for _ in range(rng.choice((0, 0, 1, 2)))
        ]
        return robots + lookers

    # -- the session --------------------------------------------------------------------------------------------------

    def _start(self, rng: random.Random) -> None:
        gateway = Gateway(self.config)
        self._hub = hub = Hub(Session(gateway), self.clock, [self._dispatch, self._record])
        notes: list[Note] = []
        if self.kind == "zenoh":
            self._side = zenoh(self.wire, random.Random(rng.random()), notes.append)
        else:
            events = self.kind == "dds"
            self._side = dds(self.wire, random.Random(rng.random()), notes.append, counts_events=events)
        _Traffic.made = self._side
        subscriptions = Subscriptions(gateway, (), hub.note)
        self._traffic = _Traffic(BridgeOptions(), gateway, hub, subscriptions, None, None, builds_all=self._recorded)
        self._traffic.start()
        self._traffic._wanted("/PSM1/measured_cp", PoseStamped.TYPE)

    def _dispatch(self, entry: Entry) -> None:
        if entry.kind is Kind.ROS_OUT:
            self._traffic.publish(entry)

    def _record(self, entry: Entry) -> None:
        self.log.append(entry)
        if entry.kind is Kind.NOTE:
            self.codes[Note.unpack(entry.data()).code] += 1

    def run(self) -> None:
        """Play the world to its end."""
        self._hub.link(1, Note(Level.INFO, LINK_UP, "up"))
        for at_ns in range(T0_NS, T0_NS + self.lasts_ns, self._arm_period_ns):
            self.wire.plan(at_ns, self._measure)
        self.wire.plan(self.stopped_ns, self._stop)
        self.wire.run(T0_NS + self.lasts_ns + 2 * NS_PER_S)

    def _stop(self) -> None:
        self.stopped_ns = self.clock.utc_ns()
        self._side.stop()

    # -- the arm ------------------------------------------------------------------------------------------------------

    def _measure(self) -> None:
        """The arm moves by what it got, and shows where it is."""
        now_ns = self.clock.utc_ns()
        if now_ns >= self._silent_ns:
            return
        delay_ns = {"exact": 0, "late": 40 * NS_PER_MS, "slow": 0, "still": 0}[self._follows]
        got = [one for each in self._robots for one in each.got if one.at_ns + delay_ns <= now_ns]
        if got and self._follows != "still":
            target = self.place(max(got, key=lambda one: one.at_ns))
            self._at = self._at + 0.2 * (target - self._at) if self._follows == "slow" else target
        at = self._at.copy()
        self.wire.plan(now_ns + self._arm_delay_ns, lambda: self._show(now_ns, at))

    def _show(self, stamp_ns: int, at: np.ndarray[Any, Any]) -> None:
        if self._joints:
            message: Any = JointState(Header(stamp_ns), ("a", "b", "c"), at)
            topic = "/PSM1/measured_js"
        else:
            message = PoseStamped(Header(stamp_ns), (*at.tolist(), 0.0, 0.0, 0.0, 1.0))
            topic = "/PSM1/measured_cp"
        self.shown.append((self.clock.utc_ns(), at))
        self._hub.ros(topic, message.TYPE, message.pack(), stamp_ns)

    # -- the peer -----------------------------------------------------------------------------------------------------

    def _plan_commander(self, rng: random.Random) -> None:
        period_ns = rng.choice((1, 5, 10, 10, 20, 33)) * NS_PER_MS
        count = min(rng.choice((60, 120, 200)), self.lasts_ns // period_ns)
        begin_ns = T0_NS + rng.choice((100, 300, 1_000, 2_000)) * NS_PER_MS
        if rng.random() < 0.6:  # about when the robot is there
            begin_ns = max(begin_ns, self._robots[0].writer_ns + rng.choice((-200, -20, 0, 5, 50, 200)) * NS_PER_MS)
        factor, swing_s = rng.choice((0.1, 0.5, 0.8, 1.0, 1.2)), rng.choice((math.inf, 0.05, 0.2, 0.5))
        jitter_ns, old_ns = rng.choice((0, 0, 1, 8)) * NS_PER_MS, rng.choice((0, 0, 0, 60, 95)) * NS_PER_MS
        way = np.array([rng.gauss(0, 1) for _ in range(3)])
        way /= np.abs(way).max() if self._joints else np.linalg.norm(way)
        origin = np.zeros(3)
        held_ns = 0
        for number in range(count):
            sent_ns = begin_ns + number * period_ns
            if rng.random() < 0.01:  # the network stalls
                held_ns = max(held_ns, sent_ns + rng.choice((30, 200, 700)) * NS_PER_MS)
            passed_s = number * period_ns / NS_PER_S
            far = factor * self.speed * (passed_s if swing_s == math.inf else swing_s * math.sin(passed_s / swing_s))
            at_ns = max(sent_ns + (rng.randint(0, jitter_ns) if jitter_ns else 0), held_ns)
            self.wire.plan(at_ns, partial(self._command, origin + far * way, sent_ns - old_ns))
        if rng.random() < 0.2:
            at_ns = begin_ns + rng.randint(0, 1_000) * NS_PER_MS
            self.wire.plan(at_ns, lambda: self._send("STRING", "PSM1/state_command", String.of("home"), at_ns))

    def _command(self, place: np.ndarray[Any, Any], stamp_ns: int) -> None:
        if self._joints:
            self._send("SENSOR", self.device, Sensor(place.astype(">f8")), stamp_ns)
        else:
            content = Transform((1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, *place.tolist()))
            self._send("TRANSFORM", self.device, content, stamp_ns)

    def _send(self, igtl_type: str, device: str, content: Any, stamp_ns: int) -> None:
        self.sent += 1
        self._hub.igtl(1, join(encode(Message(igtl_type, device, content, ns_to_ticks(stamp_ns)))))

    # -- the judge ----------------------------------------------------------------------------------------------------

    def place(self, got: Got) -> np.ndarray[Any, Any]:
        """Return where a set point puts the arm."""
        if self._joints:
            return np.array(JointState.unpack(got.cdr).position)
        return np.array(PoseStamped.unpack(got.cdr).pose[:3])

    def _header(self, got: Got) -> Header:
        return (JointState if self._joints else PoseStamped).unpack(got.cdr).header

    def _way(self, one: np.ndarray[Any, Any], other: np.ndarray[Any, Any]) -> float:
        return float(np.abs(one - other).max() if self._joints else np.linalg.norm(one - other))

    def broken(self) -> list[str]:
        """Return the promises that were not kept: one text each, which begins with the rule."""
        texts = [text for number, each in enumerate(self.readers) for text in self._of_reader(number, each)]
        return texts + list(self._of_recording())

    def _of_reader(self, number: int, reader: Reader) -> Iterator[str]:
        got = sorted(reader.got, key=lambda one: one.stamp_ns)
        for one, other in pairwise(got):
            way, most = (
                self._way(self.place(one), self.place(other)),
                self.speed * (other.stamp_ns - one.stamp_ns) / 1e9,
            )
            if way > most + _NOTHING:
                yield f"speed: {1000 * way:.3f} mm in {(other.stamp_ns - one.stamp_ns) / 1e6:.3f} ms to reader {number}"
        for one in got:
            age_s = (one.stamp_ns - self._header(one).stamp_ns) / NS_PER_S
            if age_s > self.max_age_s:
                yield f"age: {age_s:.3f} s at its source stamp, to reader {number}"
            if one.at_ns - one.stamp_ns > self.max_age_s * NS_PER_S:
                yield f"late: {(one.at_ns - one.stamp_ns) / 1e9:.3f} s after its source stamp, to reader {number}"
            if one.stamp_ns > self.stopped_ns:
                yield f"stop: written after it, to reader {number}"
            if (where := self._seen(one.stamp_ns)) is None:
                yield f"blind: no state of the arm for a second, to reader {number}"
            elif (way := self._way(where, self.place(one))) > self.speed * _BEHIND_S + _NOTHING:
                yield f"behind: {1000 * way:.1f} mm from the arm, to reader {number}"
        if got and (where := self._seen(got[0].stamp_ns)) is not None:
            # what it did not get between the match of the writer and its own is its own loss
            deaf_ns = (
                max(reader.reader_ns, reader.deaf[1] if reader.deaf[0] <= got[0].stamp_ns else 0) - reader.writer_ns
            )
            most = self.speed * (_BEHIND_S if self.kind == "zenoh" else _BEGIN_S + max(0, deaf_ns) / NS_PER_S)
            if reader.foreign and reader.reader_ns - reader.writer_ns <= _SETTLED_NS and not any(reader.deaf):
                most = self.speed * _BEGIN_S
            if (way := self._way(where, self.place(got[0]))) > most + _NOTHING:
                yield f"begin: {1000 * way:.1f} mm from the arm at first, to reader {number}"

    def _seen(self, at_ns: int) -> np.ndarray[Any, Any] | None:
        """Return the last state that the gateway had before a write; None: there was none for a second."""
        index = bisect_right(self.shown, at_ns, key=lambda pair: pair[0]) - 1
        if index < 0 or at_ns - self.shown[index][0] > _KNOWN_NS + 1_500 * NS_PER_MS:
            return None
        return self.shown[index][1]

    def _of_recording(self) -> Iterator[str]:
        """Yield what the log of the session does not have of what was written."""
        topics = {f"/{self.device}", "/PSM1/state_command"}
        said = [(one.channel, one.data()) for one in self.log if one.kind is Kind.ROS_OUT and one.channel in topics]
        written = [(topic, cdr) for topic, _, cdr in self.wire.written if topic in topics]
        if said != written:
            yield f"record: {len(said)} commands in the recording, {len(written)} written"
        session = Session(Gateway(self.config, fast_path=False))
        for group in input_groups(self.log) if self._recorded else ():
            if session.recorded(group.input) != list(group.outputs):
                yield f"verify: the outputs of entry {group.input.seq} differ"
                return


def judged(seed: int) -> tuple[list[str], Counter[str]]:
    """Play a world of a seed recorded and not; return what is broken, and counts."""
    worlds = []
    with simulated():
        for recorded in (True, False):
            world = RobotWorld(seed, recorded=recorded)
            world.run()
            worlds.append(world)
    one, other = worlds
    broken = [*one.broken(), *other.broken()]
    if [each.got for each in one.readers] != [each.got for each in other.readers]:
        broken.append("same: the recording changes what a robot gets")
    counts = Counter({"worlds": 1, "sent": one.sent, "written": len(one.wire.written)}) + one.codes
    counts["received"] = sum(len(each.got) for each in one.readers)
    counts[one.kind] += 1
    counts["late robot"] += one._robots[0].writer_ns > T0_NS + 300 * NS_PER_MS
    counts["returning robot"] += len(one._robots) > 1
    counts["incompatible"] += any(not each.fits for each in one.readers)
    counts["foreign"] += any(each.foreign for each in one.readers)
    counts["worlds with motion"] += any(len(each.got) > 1 for each in one.readers)
    return broken, counts
