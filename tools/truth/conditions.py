"""The conditions of a world, a row for each: what it changes in the plan of an ordinary one.

An ordinary world has a tracker with two tools, an ultrasound probe, a plan, an arm of ROS with joints and a pose, a
camera with depth, clouds of both sides, and static frames.  All clocks are right, and all names differ.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

from igtl_gateway.config.configuration import TfOutRow
from tools.truth.senders import MS, Plan, Sender, Stream

Change = Callable[[Plan, random.Random], None]

_SECONDS = 1.8


def ordinary(seed: int) -> Plan:
    """The plan of a world without conditions."""
    tracker, probe = Sender("tracker", link=1), Sender("ultrasound", link=2)
    robot, camera = Sender("robot"), Sender("camera")
    streams = [
        Stream("TRANSFORM/ProbeToTracker", "transform", tracker, (1,)),
        Stream("TRANSFORM/NeedleToTracker", "transform", tracker, (2,), rank=1),
        Stream("TDATA/Tools", "tdata", tracker, (3, 4), ("Stylus", "Pointer"), rate=10, rank=2),
        Stream("POINT/Plan", "point", tracker, rate=0, start=0.05),
        Stream("STRING/Log", "string", tracker, rate=4),
        Stream("POLYDATA/Skin", "polydata", tracker, (5,), rate=3),
        Stream("IMAGE/Image", "image", probe, (1,), rate=10, rank=3),
        Stream("/tf_static", "tf_static", robot, rate=0, start=0.02),
        Stream("/tf", "tf", robot, (6, 7), ("tip", "elbow"), rate=25),
        Stream("/arm/measured_cp", "pose", robot, (8,), rate=25),
        Stream("/joint_states", "joints", robot, (0,), rate=25),
        Stream("/camera/image", "ros_image", camera, (9,), rate=10, rank=3),
        Stream("/camera/depth", "depth", camera, rate=4),
        Stream("/camera/cloud", "cloud", camera, (10,), rate=3),
    ]
    return Plan(seed, _SECONDS, [tracker, probe, robot, camera], streams)


def _order(plan: Plan, chance: random.Random) -> None:
    """Messages of a moment come in a random order."""
    ranks = list(range(len(plan.streams)))
    chance.shuffle(ranks)
    for stream, rank in zip(plan.streams, ranks, strict=True):
        stream.rank = rank


def _images_first(plan: Plan, _: random.Random) -> None:
    """Pictures come before the poses of their moment."""
    for stream in plan.streams:
        stream.rank = 0 if "image" in stream.kind else 5


def _delay(plan: Plan, chance: random.Random) -> None:
    """Half of the streams are 20 to 300 ms late, with right stamps."""
    for stream in plan.streams:
        if stream.rate and chance.random() < 0.5:
            stream.extra_ns = chance.choice((20, 60, 120, 300)) * MS


def _late_images(plan: Plan, chance: random.Random) -> None:
    """All pictures are 60 to 250 ms late, with right stamps."""
    late_ns = chance.choice((60, 100, 250)) * MS
    for stream in plan.streams:
        stream.extra_ns = late_ns if "image" in stream.kind else 0


def _jitter(plan: Plan, chance: random.Random) -> None:
    """Receipt has up to 40 ms of jitter."""
    for sender in plan.senders:
        sender.jitter_ns = chance.choice((2, 10, 40)) * MS


def _stamp_jitter(plan: Plan, _: random.Random) -> None:
    """Stamps have 0.5 ms of jitter."""
    for sender in plan.senders:
        sender.stamp_jitter_ns = MS // 2


def _one_clock_apart(plan: Plan, chance: random.Random) -> None:
    """One sender has a clock of its own."""
    chance.choice(plan.senders).offset_ns = chance.choice((-3000, -400, 150, 400, 3000, 40_000)) * MS


def _clocks_apart(plan: Plan, chance: random.Random) -> None:
    """Each sender has a clock of its own, up to 5 s off."""
    for sender in plan.senders:
        sender.offset_ns = chance.randint(-5000, 5000) * MS


def _common_clock_apart(plan: Plan, chance: random.Random) -> None:
    """All senders have one clock, which is not that of the gateway."""
    offset_ns = chance.choice((-7000, -300, 300, 90_000)) * MS
    for sender in plan.senders:
        sender.offset_ns = offset_ns


def _drift(plan: Plan, chance: random.Random) -> None:
    """A clock drifts by 100 ppm."""
    chance.choice(plan.senders).drift_ppm = chance.choice((-100.0, 100.0))


def _two_publishers(plan: Plan, _: random.Random) -> None:
    """Two arms share one topic of joints."""
    robot = next(one for one in plan.senders if one.name == "robot")
    plan.streams.append(Stream("/joint_states", "joints", robot, (1,), rate=20, extra_ns=3 * MS))


def _two_peers(plan: Plan, _: random.Random) -> None:
    """Two peers send a device of one name."""
    other = Sender("tracker2", link=3)
    plan.senders.append(other)
    plan.streams.append(Stream("TRANSFORM/ProbeToTracker", "transform", other, (11,), extra_ns=4 * MS))


def _permuted(plan: Plan, _: random.Random) -> None:
    """Names, points and fields come in another order in each message."""
    for stream in plan.streams:
        stream.permuted = True


def _like_names(plan: Plan, chance: random.Random) -> None:
    """Tools whose names differ in a sign only."""
    tracker = plan.senders[0]
    names = ["Tool A", "Tool_A", "Tool-A", "Tool.A", "ToolA", "Tool/A"]
    chance.shuffle(names)
    for number, name in enumerate(names[: chance.randint(2, 4)]):
        plan.streams.append(Stream(f"TRANSFORM/{name}", "transform", tracker, (12 + number,), rate=25))


def _both_sides(plan: Plan, _: random.Random) -> None:
    """Poses of ROS go to the peers."""
    plan.config["tf_out"] = (TfOutRow(frames=("tip",), base="base", device="Tip"),)
    robot = next(one for one in plan.senders if one.name == "robot")
    plan.streams.append(Stream("/igtl/out/Hand", "pose", robot, (16,), rate=25))


def _tracking_out(plan: Plan, _: random.Random) -> None:
    """Frames that come at different times become one TDATA."""
    row = TfOutRow(frames=("tip", "slow"), base="base", device="Frames", type="TDATA")
    plan.config["tf_out"] = (row,)
    robot = next(one for one in plan.senders if one.name == "robot")
    plan.streams.append(Stream("/tf", "tf", robot, (17,), ("slow",), rate=10, extra_ns=300 * MS))


def _only_ros_poses(plan: Plan, _: random.Random) -> None:
    """The image is of a peer, all poses are of ROS."""
    _both_sides(plan, random.Random(0))
    plan.streams = [one for one in plan.streams if one.kind not in ("transform", "tdata")]


def _version(version: int) -> Change:
    def change(plan: Plan, _: random.Random) -> None:
        for sender in plan.senders:
            sender.version = version

    change.__doc__ = f"All headers have version {version}."
    return change


def _mixed_versions(plan: Plan, chance: random.Random) -> None:
    """Senders have header version 1 or 2."""
    for sender in plan.senders:
        sender.version = chance.choice((1, 2))


def _crc_off(plan: Plan, _: random.Random) -> None:
    """No message has a CRC, and the gateway does not check it."""
    plan.config["check_crc"] = False
    for sender in plan.senders:
        sender.crc = False


def _unstamped(plan: Plan, _: random.Random) -> None:
    """No message has a stamp."""
    for sender in plan.senders:
        sender.stamped = False


def _some_unstamped(plan: Plan, chance: random.Random) -> None:
    """One of the peers sends no stamps."""
    chance.choice(plan.senders[:2]).stamped = False


def _unstamped_apart(plan: Plan, _: random.Random) -> None:
    """Pictures have no stamps, and the clock of the tracker is 3 s ahead."""
    plan.senders[0].offset_ns = 3000 * MS
    plan.senders[1].stamped = False


def _gaps(plan: Plan, chance: random.Random) -> None:
    """Half of the streams pause for 0.2 to 0.9 s."""
    for stream in plan.streams:
        if stream.rate and chance.random() < 0.5:
            start = chance.uniform(0.3, 1.0)
            stream.gaps.append((start, start + chance.choice((0.2, 0.5, 0.9))))


def _unseen_tool(plan: Plan, chance: random.Random) -> None:
    """A tool is not seen for 0.7 s."""
    start = chance.uniform(0.3, 0.6)
    plan.streams[0].gaps.append((start, start + 0.7))


def _starts(plan: Plan, chance: random.Random) -> None:
    """Streams begin after others, and end before them."""
    for stream in plan.streams:
        if stream.rate and chance.random() < 0.6:
            stream.start, stream.end = chance.choice((0.0, 0.4, 0.7)), chance.choice((1.1, 1.5, 9.0))


def _merge(plan: Plan, chance: random.Random) -> None:
    """The robot and the camera have a recorder of their own, with another clock, which they share."""
    plan.recorder_offset_ns = chance.choice((-7500, 400, 3000)) * MS
    for sender in plan.senders:
        if not sender.link:
            sender.recorder, sender.offset_ns = 1, sender.offset_ns + plan.recorder_offset_ns
    plan.files.append("merge")


def _merge_peers(plan: Plan, chance: random.Random) -> None:
    """The ultrasound has a recorder of its own, with another clock, which it shares."""
    plan.recorder_offset_ns = chance.choice((-7500, 400, 3000)) * MS
    plan.senders[1].recorder = 1
    plan.senders[1].offset_ns += plan.recorder_offset_ns
    plan.files.append("merge")


def _file(verb: str, meaning: str) -> Change:
    def change(plan: Plan, _: random.Random) -> None:
        plan.files.append(verb)

    change.__doc__ = meaning
    return change


#: Name of a condition → its change.
CONDITIONS: dict[str, Change] = {
    "order": _order,
    "images_first": _images_first,
    "delay": _delay,
    "late_images": _late_images,
    "jitter": _jitter,
    "stamp_jitter": _stamp_jitter,
    "one_clock_apart": _one_clock_apart,
    "clocks_apart": _clocks_apart,
    "common_clock_apart": _common_clock_apart,
    "drift": _drift,
    "two_publishers": _two_publishers,
    "two_peers": _two_peers,
    "permuted": _permuted,
    "like_names": _like_names,
    "both_sides": _both_sides,
    "tracking_out": _tracking_out,
    "only_ros_poses": _only_ros_poses,
    "version_2": _version(2),
    "version_3": _version(3),
    "mixed_versions": _mixed_versions,
    "crc_off": _crc_off,
    "unstamped": _unstamped,
    "some_unstamped": _some_unstamped,
    "unstamped_apart": _unstamped_apart,
    "gaps": _gaps,
    "unseen_tool": _unseen_tool,
    "starts": _starts,
    "parts": _file("parts", "The recording is split."),
    "one_part": _file("one_part", "Only the second part is there."),
    "snapshot": _file("snapshot", "The last 0.9 s, by the black box."),
    "foreign": _file("foreign", "A bag of another program; times of receipt are rounded to 40 ms."),
    "slice": _file("slice", "0.8 s from the middle."),
    "merge": _merge,
    "merge_peers": _merge_peers,
    "recover": _file("recover", "The file is cut at four fifths."),
    "deidentify": _file("deidentify", "With names and text kept; times move by a day."),
    "seal": _file("seal", "A sealed copy."),
}

#: Only one of each of these is in a world.
_EXCLUSIVE: Sequence[frozenset[str]] = (
    frozenset({"parts", "one_part", "snapshot"}),
    frozenset({"merge", "merge_peers", "slice", "recover", "foreign"}),
    frozenset({"foreign", "parts", "one_part", "snapshot", "deidentify", "seal"}),
    frozenset({"version_2", "version_3", "mixed_versions"}),
    frozenset({"both_sides", "tracking_out", "only_ros_poses"}),
    frozenset({"unstamped", "some_unstamped", "unstamped_apart"}),
    frozenset({"unstamped_apart", "clocks_apart", "one_clock_apart", "common_clock_apart"}),
    frozenset({"only_ros_poses", "like_names"}),
    frozenset({"only_ros_poses", "two_peers"}),
    frozenset({"only_ros_poses", "unseen_tool"}),
)


def chosen(seed: int) -> tuple[str, ...]:
    """The conditions of a world: up to four, in the order of the table; the first worlds have one each, then none."""
    names = list(CONDITIONS)
    if seed <= len(names):
        return (names[seed - 1],) if seed else ()
    chance = random.Random(f"conditions {seed}")
    found: list[str] = []
    for name in chance.sample(names, chance.randint(1, 4)):
        if not any(name in group and group & set(found) for group in _EXCLUSIVE):
            found.append(name)
    return tuple(sorted(found, key=names.index))


def plan_of(seed: int, names: Sequence[str] | None = None) -> Plan:
    """The plan of a world with these conditions, or with those that its seed chooses.  Raises KeyError."""
    plan = ordinary(seed)
    plan.conditions = chosen(seed) if names is None else tuple(names)
    for name in plan.conditions:
        CONDITIONS[name](plan, random.Random(f"{seed} {name}"))
    return plan
