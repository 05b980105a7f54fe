"""The ways out of the product, a row for each: what it is asked, and which reader of others judges the result."""

from __future__ import annotations

import socket
import threading
import warnings
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import igtl_gateway
from igtl_gateway.addons.lerobot import dataset
from igtl_gateway.base.errors import GatewayError
from tools.truth.conditions import plan_of
from tools.truth.files import Printed, Recording, make, product
from tools.truth.judges import arrays, files, igtl, lerobot, ros, rrd, tables
from tools.truth.judges.samples import Sample
from tools.truth.judges.truth import LOST, NAME, TIME, Findings, Truth
from tools.truth.senders import MS, Plan, Stream
from tools.truth.world import BEGIN_NS

#: The jitter of two stamps, s; the largest distance that ``align`` is asked for.
_JITTER_S, _ALIGN_S = 0.0012, 0.06
#: A picture of 10 Hz at a moment of 10 Hz; joints are held; s.
_LEROBOT_S = 0.0612
#: Duration of the recording that a set has before another one is appended, s.
_FIRST_S = 1.2
_DEADLINE_S = 60.0
#: What ``align`` is asked for.
_ASKED = [(clock, method) for clock in ("gateway", "source") for method in ("nearest", "interpolate")]


@dataclass
class Case:
    """A world on its way out.

    Attributes:
        plan, recording, truth: of the world.
        folder: for results; new.
    """

    plan: Plan
    recording: Recording
    truth: Truth
    folder: Path
    number: int = 0

    def out(self, name: str) -> Path:
        self.number += 1
        return self.folder / f"out{self.number}{name}"


@dataclass
class Result:
    """What a route gave: the exit code and text of the product, and what the judge found."""

    code: int
    text: str
    findings: Findings = field(default_factory=Findings)


@dataclass(frozen=True)
class Route:
    """A way out.

    Attributes:
        run: takes it.
        reader: that judges, for the table.
        tolerance: that holds, for the table.
        every, turn: one world in this number takes it, where routes are alike or cost much, and which one.
    """

    run: Callable[[Case], Result]
    reader: str
    tolerance: str
    every: int = 1
    turn: int = 0


#: Kinds of streams that a table, a bag or a view has.
_ALL = ("transform", "tdata", "string", "point", "tf_static", "tf", "pose", "joints")
_PICTURES = ("image", "ros_image", "depth")
_CLOUDS = ("polydata", "cloud")


def _table(to: str, reader: Callable[[Path], Iterable[Sample]], kinds: tuple[str, ...]) -> Callable[[Case], Result]:
    def run(case: Case) -> Result:
        out = case.out("-tables")
        printed = product("export", case.recording.path, "--to", to, "-o", out)
        return _judged(case, printed, reader(out) if out.exists() else (), kinds)

    return run


def _judged(case: Case, printed: Printed, samples: Iterable[Sample], kinds: tuple[str, ...]) -> Result:
    result = Result(printed.code, printed.text)
    found = list(samples)
    result.findings = case.truth.judge(found)
    if found or printed.code == 0:
        case.truth.lost(result.findings, kinds)
    return result


def _bag(case: Case) -> Result:
    out = case.out("-bag")
    printed = product("export", case.recording.path, "--to", "rosbag2", "-o", out)
    reader = ros.by_mcap if case.plan.seed % 2 else ros.by_rosbags
    return _judged(case, printed, reader(out) if out.exists() else (), (*_ALL, *_PICTURES, *_CLOUDS))


def _each_file(to: str, reader: Callable[[Path], Iterable[Sample]], kinds: tuple[str, ...]) -> Callable[[Case], Result]:
    def run(case: Case) -> Result:
        out = case.out("-files")
        printed = product("export", case.recording.path, "--to", to, "-o", out)
        return _judged(case, printed, reader(out) if out.exists() else (), kinds)

    return run


def _sequence(case: Case) -> Result:
    out = case.out(".igs.mha")
    printed = product("export", case.recording.path, "--to", "igs.mha", "-o", out)
    result = Result(printed.code, printed.text)
    if out.exists():
        frames = list(files.by_itk(out))
        samples = [one for reference, others in frames for one in (reference, *others)]
        result.findings = case.truth.judge(samples, interpolated=True)
        case.truth.judge_frames(frames, result.findings, _JITTER_S, _stated(printed.text), nearest=True)
        _names_of_sequence(case, samples, printed, result.findings)
    return result


def _names_of_sequence(case: Case, samples: list[Sample], printed: Printed, findings: Findings) -> None:
    """A transform without other signs has the name of its own device, or the output has the map."""
    for sample in samples:
        if sample.kind != "pose":
            continue
        thing = ("pose", int(sample.value[0, 3] // 1000))
        names = case.truth.names_of(thing)
        if sample.name in {each.replace("Transform", "") for each in names} or not sample.name:
            continue
        if any(other.key == f"TRANSFORM/{sample.name}" for other in case.plan.streams):
            findings.fault(NAME, sorted(names), f"{sample.name}Transform is that of {sorted(names)}")


def _stated(text: str) -> str:
    """The clock that an output states: "gateway" if values are together by time of receipt."""
    shows = any(
        words in line
        for line in text.splitlines()
        for words in ("clock: gateway", "gateway time", "time of receipt", "times of receipt", "by receipt")
    )
    return "gateway" if shows else ""


def _rrd(case: Case) -> Result:
    out = case.out(".rrd")
    printed = product("view", case.recording.path, "-o", out, "--no-review")
    result = _judged(case, printed, rrd.by_rerun(out) if out.exists() else (), (*_ALL, *_PICTURES, *_CLOUDS))
    result.text += rrd.stated_in(out) if out.exists() else ""
    return result


def _asked(case: Case) -> dict[str, Stream]:
    """Key of a stream in the file → the stream, of those whose name is found.  Raises GatewayError."""
    with igtl_gateway.open(case.recording.path) as recording:
        keys = list(recording)
    found: dict[str, Stream] = {}
    for stream in case.plan.streams:
        if key := arrays.key_of(keys, stream.key):
            found.setdefault(key, stream)
    return found


def _recipe(case: Case, of_set: tuple[str, ...] = (), of_numbers: tuple[str, ...] = ()) -> str:
    """A recipe with all that a frame can have; streams that the file does not have are left out.

    Args:
        case: a world.
        of_set, of_numbers: further lines of the set, and of each row with numbers.
    """
    lines = ["[dataset]", "fps = 10", 'task = "look"', f'format = "{"v3.0" if case.plan.seed % 2 else "v2.1"}"']
    lines += [*of_set, "[episodes]", 'by = "whole"']
    for key, stream in _asked(case).items():
        if stream.kind in ("transform", "pose"):
            lines += ["[[feature]]", 'name = "observation.state"', f'stream = "{key}"', "tolerance_ms = 100"]
            lines += of_numbers
        elif stream.kind == "joints":
            lines += ["[[feature]]", 'name = "observation.state"', f'stream = "{key}"', 'fields = ["position"]']
            lines += ["tolerance_ms = 60", *of_numbers]
        elif stream.kind in ("image", "ros_image"):
            name = "us" if stream.kind == "image" else "camera"
            lines += ["[[feature]]", f'name = "observation.images.{name}"', f'stream = "{key}"', "tolerance_ms = 60"]
    lines += ["[[feature]]", 'name = "action"', 'next_of = "observation.state"']
    return "\n".join(lines) + "\n"


def _exported(case: Case, *words: object, recipe: str = "") -> tuple[Path, Printed]:
    """A set of the world, and what its export printed."""
    out, path = case.out("-set"), case.out(".toml")
    try:
        path.write_text(recipe or _recipe(case))
    except GatewayError as error:
        return out, Printed(1, str(error))
    words = (*words, "--recipe", path, "-o", out)
    return out, product("export", case.recording.path, "--to", "lerobot", *words)


def _judge_set(truth: Truth, result: Result, frames: Iterable[Any], stated: str) -> None:
    """Compare the frames of a data set; ``stated`` is what it states about its clock."""
    frames = list(frames)
    found = truth.judge([one for reference, others in frames for one in (reference, *others)], interpolated=True)
    held = ("joint", "video", "picture", "text")  # a picture before the moment of the frame, and one after it
    for within_s, kinds in ((_LEROBOT_S, ("pose",)), (2 * _LEROBOT_S, held)):
        part = [(reference, [one for one in others if one.kind in kinds]) for reference, others in frames]
        truth.judge_frames(part, found, within_s, stated)
    result.findings.samples += found.samples
    for each in found.faults:
        result.findings.fault(each.kind, each.about, each.text)


def _lerobot(case: Case) -> Result:
    out, printed = _exported(case)
    result = Result(printed.code, printed.text)
    if out.exists():
        result.text += product("export", case.recording.path, "--to", "lerobot", "--check", out).text
        _judge_set(case.truth, result, lerobot.by_pyarrow(out), _stated(printed.text))
    return result


def _lerobot_samples(case: Case) -> Result:
    result, recipe = Result(0, ""), case.out(".toml")
    with warnings.catch_warnings(record=True) as stated:
        warnings.simplefilter("always")
        try:
            recipe.write_text(_recipe(case))
            with closing(dataset(case.recording.path, recipe)) as found:
                frames = lerobot.by_samples(found, found.features)
                _judge_set(case.truth, result, frames, _stated(f"clock: {found.clock}"))
        except GatewayError as error:
            result.code, result.text = 1, str(error)
    result.text += "".join(f"\n{each.message}" for each in stated)
    return result


def _lerobot_append(case: Case) -> Result:
    """A set of an ordinary world, to which this one is appended; both are judged."""
    first = replace(plan_of(case.plan.seed, ()), seconds=_FIRST_S)
    folder = case.out("-first")
    folder.mkdir()
    recording = make(first, folder)
    before = Case(first, recording, Truth(first, recording), folder)
    try:
        recipe = _recipe(case)
    except GatewayError as error:
        return Result(1, str(error))
    out, printed = _exported(before, recipe=recipe)
    if printed.code:  # it does not have the streams of this one
        return Result(printed.code, printed.text)
    count = len(list(lerobot.by_pyarrow(out)))
    words = ("--append", "--recipe", out / "meta" / "recipe.toml", "-o", out)
    added = product("export", case.recording.path, "--to", "lerobot", *words)
    result = Result(added.code, printed.text + added.text)
    result.text += (out / "meta" / "SYNCHRONIZATION.md").read_text()  # a note of the output names it
    frames = list(lerobot.by_pyarrow(out))
    _judge_set(before.truth, result, frames[:count], _stated(printed.text))
    _judge_set(case.truth, result, frames[count:], _stated(added.text))
    return result


def _lerobot_import(case: Case) -> Result:
    """The set becomes a session, whose values are compared at their stamps."""
    out, printed = _exported(case)
    result, session = Result(printed.code, printed.text), case.out(".mcap")
    if out.exists():
        done = product("import", out, "-o", session)
        result.code, result.text = done.code, result.text + done.text
    if session.exists():
        frames, other_times = lerobot.by_mcap(session, out)
        _judge_set(case.truth, result, frames, _stated(printed.text))
        if other_times:
            result.findings.fault(TIME, (), f"{other_times} stamps of the session or times of the set have no other")
    return result


def _lerobot_stamps(case: Case) -> Result:
    """Each value has the stamp of its message, and the native tables have all messages."""
    try:
        recipe = _recipe(case, ("stamps = true",), ("native = true",))
    except GatewayError as error:
        return Result(1, str(error))
    out, printed = _exported(case, recipe=recipe)
    samples = list(lerobot.by_stamps(out, printed.text.rpartition("clock: ")[2].strip())) if out.exists() else []
    result = Result(printed.code, printed.text)
    result.findings = case.truth.judge(samples)
    if samples:
        asked = {stream.key for stream in _asked(case).values()}
        case.truth.lost(result.findings, ("transform", "pose", "joints"), asked)
    return result


def _in_python(find: Callable[[Case, Any, Result], None]) -> Callable[[Case], Result]:
    def run(case: Case) -> Result:
        result = Result(0, "")
        with warnings.catch_warnings(record=True) as stated:
            warnings.simplefilter("always")
            try:
                with igtl_gateway.open(case.recording.path) as recording:
                    find(case, recording, result)
                    notes = [f"{note.stream} {note.text}" for note in recording.notes if note.level != "INFO"]
                    result.text += "\n".join([*map(str, recording.warnings), *notes])
            except GatewayError as error:
                result.code, result.text = 1, f"{result.text}\n{error}"
        result.text += "".join(f"\n{each.message}" for each in stated)
        return result

    return run


def _streams(case: Case, recording: Any, result: Result) -> None:
    result.findings = case.truth.judge(list(arrays.of_streams(recording)))
    kinds = ("transform", "tdata", "pose", "tf", "image", "ros_image", "depth", "cloud")
    # a merged session has the surfaces of peers as igtl_msgs/PolyData, of which ``points`` reads none
    case.truth.lost(result.findings, kinds if "merge" in case.plan.files else (*kinds, "polydata"))


def _pictures(recording: Any) -> Any:
    for stream in ("IMAGE/Image", "/camera/image"):
        key = arrays.key_of(list(recording), stream)
        if key and len(recording[key].times):
            return recording[key]
    raise GatewayError("found no pictures to align with")


def _align(case: Case, recording: Any, result: Result) -> None:
    on = _pictures(recording)
    refusals = []
    for clock, method in _ASKED:
        try:
            frames = list(arrays.aligned(recording, on, clock, method, _ALIGN_S))
        except GatewayError as error:
            refusals.append(f"{clock}: {error}")
            continue
        samples = [one for reference, others in frames for one in (reference, *others)]
        found = case.truth.judge(samples, interpolated=True)
        # asked for gateway time, it is by receipt; asked for the senders' stamps, it has to be by these
        case.truth.judge_frames(frames, found, _ALIGN_S + _JITTER_S, clock if clock == "gateway" else "")
        result.findings.samples += found.samples
        for each in found.faults:
            result.findings.fault(each.kind, each.about, f"align {clock} {method}: {each.text}")
    result.text += "\n".join(refusals)
    result.code = int(len(refusals) == len(_ASKED))


def _lookup(case: Case, recording: Any, result: Result) -> None:
    on = _pictures(recording)
    frames = list(arrays.looked_up(recording, on))
    samples = [one for reference, others in frames for one in (reference, *others)]
    result.findings = case.truth.judge(samples, interpolated=True)
    # what has no stamp is at its time of receipt: later by its delay
    late_s = max(
        0.0 if one.sender.stamped else (one.sender.delay_ns + one.sender.jitter_ns + one.extra_ns) / 1e9 + 0.0005
        for one in case.plan.streams
    )
    case.truth.judge_frames(frames, result.findings, _JITTER_S + late_s)
    if any(stream.kind == "tf_static" for stream in case.plan.streams):
        case.truth.lost(result.findings, ("tf_static",))


def _cohort(case: Case) -> Result:
    out = case.out("-study")
    printed = product("cohort", "info", case.recording.path, "-o", out)
    result = Result(printed.code, printed.text)
    rows = tables.cohort_streams(out) if out.exists() else []
    sent: dict[str, list[int]] = {}
    for one in case.plan.messages():
        sent.setdefault(one.stream.key, []).append(BEGIN_NS + one.receipt_ns + case.recording.shift_ns)
    counts: dict[str, int] = {}
    for row in sorted(rows, key=lambda row: row["first"]):
        key = row["stream"]
        if "merge" in case.plan.files:  # a merged session has a level for each part
            key = "/" + key.removeprefix("/").partition("/")[2]
        # an output can have the name of an input of ROS
        if key not in sent or not (row["direction"].endswith("_in") or "merge" in case.plan.files):
            continue
        result.findings.samples += 1
        found_ns = int(row["first"].value)
        if key not in counts and case.recording.whole and abs(found_ns - sent[key][0]) > MS and key != "/tf":
            result.findings.fault(TIME, (key,), f"{key}: {(found_ns - sent[key][0]) / 1e6} ms")
        counts[key] = counts.get(key, 0) + row["messages"]
    for key, count in counts.items():
        if case.recording.whole and count != len(sent[key]) and not ("merge" in case.plan.files and key == "/tf"):
            result.findings.fault(LOST, (key,), f"{key}: {count} of {len(sent[key])}")
    return result


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def _to_igtl(case: Case) -> Result:
    port = _free_port()
    data: list[bytes] = []

    def read() -> None:
        for _ in range(200):
            try:
                data.append(igtl.received(("127.0.0.1", port), _DEADLINE_S))
            except ConnectionRefusedError:
                done.wait(0.05)
                if done.is_set():
                    return
                continue
            return

    done = threading.Event()
    reader = threading.Thread(target=read)
    reader.start()
    words = ("--listen", f"127.0.0.1:{port}", "--as-fast-as-possible", "--side", "both")
    printed = product("replay", case.recording.path, "--to", "igtl", *words)
    done.set()
    reader.join(_DEADLINE_S)
    kinds = ("transform", "image", "string", "point")
    return _judged(case, printed, igtl.by_pyigtl(b"".join(data)), kinds)


def _to_ros(case: Case) -> Result:
    from tools.truth.judges.graph import Listener  # rclpy is not everywhere

    try:
        with igtl_gateway.open(case.recording.path) as recording:
            topics = {
                key.rpartition(":")[2]: stream.type for key, stream in recording.items() if stream.type.count("/") == 2
            }
    except GatewayError as error:
        return Result(1, str(error))
    with Listener(topics) as listener:
        words = ["--as-fast-as-possible", "--wait-peers", "1"]
        for topic in listener.topics:
            words += ["--streams", topic]
        printed = product("replay", case.recording.path, "--to", "ros", *words)
        samples = list(listener.samples())
    return _judged(case, printed, samples, ("tf", "pose", "joints", *_PICTURES, "cloud"))


#: Name of a route → how it is taken and judged.
ROUTES: dict[str, Route] = {
    "csv": Route(_table("csv", tables.by_pandas, _ALL), "pandas", "0.05 mm; stamps 3 µs; receipt 1 ms", 3),
    "parquet": Route(
        _table("parquet", tables.by_parquet, (*_ALL, "image", "ros_image", "depth", "polydata")),
        "pyarrow",
        "0.05 mm; stamps 3 µs; receipt 1 ms; pixels exact",
        3,
        1,
    ),
    "arrow": Route(
        _table("arrow", tables.by_feather, (*_ALL, "image", "ros_image", "depth", "polydata")),
        "pyarrow (Feather)",
        "as parquet",
        3,
        2,
    ),
    "rosbag2": Route(_bag, "rosbags; mcap with mcap-ros2-support", "as parquet", 3),
    "igs.mha": Route(
        _sequence, "SimpleITK", "poses half a period and 1.2 ms beside their picture; pixels and place exact"
    ),
    "vtk": Route(_each_file("vtk", files.by_vtk, _CLOUDS), "VTK", "0.05 mm, RAS as 3D Slicer reads it", 4),
    "ply": Route(
        _each_file("ply", files.by_meshio, _CLOUDS), "meshio, VTK", "0.05 mm, RAS as 3D Slicer reads it", 4, 1
    ),
    "nrrd": Route(
        _each_file("nrrd", files.by_nrrd, _PICTURES), "pynrrd, SimpleITK", "pixels exact; place 0.01 mm", 4, 2
    ),
    "view": Route(_rrd, "rerun", "as parquet, for each time line", 3, 1),
    "lerobot": Route(
        _lerobot, "pyarrow, PyAV", "tolerance of the recipe: poses 61.2 ms, held values 122.4 ms beside the picture", 3
    ),
    "lerobot_samples": Route(_lerobot_samples, "numpy", "as lerobot, by `dataset()`; pixels exact", 6),
    "lerobot_append": Route(_lerobot_append, "pyarrow, PyAV", "as lerobot, behind the set of another recording", 6, 1),
    "lerobot_import": Route(_lerobot_import, "mcap with mcap-ros2-support, PyAV", "as lerobot, at equal stamps", 6, 2),
    "lerobot_stamps": Route(_lerobot_stamps, "pyarrow, PyAV", "`stamps`, `native`: stamps 3 µs; receipt 1 ms", 6, 3),
    "python": Route(_in_python(_streams), "numpy", "as parquet", 2),
    "align": Route(_in_python(_align), "numpy", "61.2 ms (the tolerance asked for) on the clock asked for", 2, 1),
    "lookup": Route(_in_python(_lookup), "numpy", "1.2 ms beside the picture", 2),
    "cohort": Route(_cohort, "pyarrow", "counts exact; first time 1 ms", 10, 1),
    "to_igtl": Route(_to_igtl, "pyigtl", "0.05 mm; stamps 3 µs", 20, 2),
    "to_ros": Route(_to_ros, "rclpy", "0.05 mm; stamps 3 µs", 20, 3),
}
