"""JUnit XML and the lines of a verdict.

The rules of the report are those of Jenkins' schema (junit-10.xsd) for the elements and attributes that we write; a
report was also validated by that schema and read by junitparser.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree

from igtl_gateway.addon.reading import Qos
from igtl_gateway.addons.resim import outputs, processes
from igtl_gateway.addons.resim.coordinator import Roles
from igtl_gateway.addons.resim.engine import Run, RunResult, faster
from igtl_gateway.addons.resim.outputs import OutputFile, OutputStream
from igtl_gateway.addons.resim.processes import Process, ThreadUse
from igtl_gateway.addons.resim.report import junit_xml, report_lines
from igtl_gateway.addons.resim.verdict import Difference, Race, StreamVerdict, Verdict, compare
from igtl_gateway.replay.compare import Delta
from tests.addons.resim import sessions
from tests.tables import table

#: Element → the attributes that it must have, those that it may have, and its children.
RULES: dict[str, tuple[set[str], set[str], set[str]]] = {
    "testsuites": (set(), {"name", "time", "tests", "failures", "disabled", "errors"}, {"testsuite"}),
    "testsuite": ({"name", "tests"}, {"failures", "errors", "time", "skipped"}, {"testcase", "properties"}),
    "testcase": ({"name"}, {"classname", "time"}, {"skipped", "error", "failure"}),
    "properties": (set(), set(), {"property"}),
    "property": ({"name", "value"}, set(), set()),
    "failure": (set(), {"message", "type"}, set()),
    "error": (set(), {"message", "type"}, set()),
    "skipped": (set(), {"message", "type"}, set()),
}


def parsed(result: RunResult, verdict: Verdict) -> dict[str, tuple[str, str]]:
    """Name of a test case → its outcome and message; the report keeps the rules."""
    root = ElementTree.fromstring(junit_xml(result, verdict))
    assert root.tag == "testsuites"
    for each in root.iter():
        must, may, children = RULES[each.tag]
        assert must <= set(each.attrib) <= must | may, each.tag
        assert {child.tag for child in each} <= children, each.tag
    (suite,) = root
    for parent in (root, suite):
        counts = {tag: len(list(suite.iter(tag))) for tag in ("testcase", "failure", "error")}
        assert [int(parent.attrib[name]) for name in ("tests", "failures", "errors")] == list(counts.values())
        assert float(parent.attrib["time"]) >= 0
    assert int(suite.attrib["skipped"]) == len(list(suite.iter("skipped")))
    return {
        case.attrib["name"]: (case[0].tag, case[0].attrib["message"]) if len(case) else ("passed", "")
        for case in suite.iter("testcase")
    }


def result_of(*names: str) -> RunResult:
    """Two runs with these streams."""
    streams = {name: OutputStream(name, "std_msgs/msg/String", Qos(), 3) for name in names}
    roles = Roles({"/in": 1200}, list(names), [], ["/map"], [], [], {}, {})
    return RunResult(Path("lab.mcap"), roles, [Run(n, Path("none"), streams, seconds=1.5) for n in (1, 2)])


def differing(name: str, number: int = 4) -> StreamVerdict:
    delta = Delta("pose.x", 1.0, 1.001, mm=1.0)
    return StreamVerdict(name, 9, 9, 5, 1, mm=2.5, first=Difference(name, number, 7_000_000, "differs", 0, delta))


def test_all_equal() -> None:
    verdict = Verdict(2, 0, reference=Path("good.mcap"), streams=[StreamVerdict("/out", 3, 3)])
    assert parsed(result_of("/out", "/rosout"), verdict) == {
        "deterministic: 2 runs": ("passed", ""),
        "/out": ("passed", ""),
    }
    assert report_lines(result_of("/out", "/rosout"), verdict) == [
        "deterministic: 2 of 2 runs equal; equal to good.mcap",
        "  inputs: /in (1,200)",
        "  outputs: /out",
        "  asked for, but not recorded: /map",
    ]


def test_a_difference_from_the_baseline() -> None:
    verdict = Verdict(2, 0, reference=Path("good.mcap"), streams=[StreamVerdict("/a", 3, 3), differing("/b")])
    text = "/b, message 4 at 0.007000 s: pose.x is 1.0 and 1.001 (1 mm)"
    assert parsed(result_of("/a", "/b", "/c"), verdict) == {
        "deterministic: 2 runs": ("passed", ""),
        "/a": ("passed", ""),
        "/b": ("failure", text),
        "/c": ("skipped", "not compared: not in good.mcap"),
    }
    assert report_lines(result_of("/a", "/b", "/c"), verdict)[:3] == [
        f"DIFFERENT from good.mcap in 1 of 2 streams (deterministic: 2 of 2 runs equal): {text}",
        "  /b: 9 messages: 5 differ, 1 missing; at most 2.5 mm",
        f"    first: {text}",
    ]


def test_runs_that_differ() -> None:
    verdict = Verdict(2, 0, unequal_run=2, between_runs=[differing("/b")], reference=Path("good.mcap"))
    found = parsed(result_of("/a", "/b"), verdict)
    assert [outcome for outcome, _ in found.values()] == ["failure", "skipped", "failure"]
    assert "NOT DETERMINISTIC: run 2 differs from run 1: /b, message 4" in found["deterministic: 2 runs"][1]


def test_a_race_is_a_failure() -> None:
    race = Race(Difference("/out", 4, 7_000_000, "differs", 0, Delta("data", 1, 2)), "/in")
    verdict = Verdict(2, 0, race=race, reference=Path("good.mcap"), streams=[StreamVerdict("/out", 3, 3)])
    found = parsed(result_of("/out"), verdict)
    text = "a timer races /in: /out, message 4 at 0.007000 s: data is 1 and 2 if the timer is first"
    assert [outcome for outcome, _ in found.values()] == ["failure", "passed"]
    assert f"NOT DETERMINISTIC: {text}; likely cause: a timer and an input" in found["deterministic: 2 runs"][1]
    verdict.permits_races = True
    assert parsed(result_of("/out"), verdict)["deterministic: 2 runs"] == ("passed", "")
    (remark,) = ElementTree.fromstring(junit_xml(result_of("/out"), verdict)).iter("property")
    assert remark.attrib["value"] == text
    verdict.race = replace(race, earlier_ns=17_000_000, is_sample=True)  # of no fault: a controller samples
    verdict.permits_races = False
    assert parsed(result_of("/out"), verdict)["deterministic: 2 runs"] == ("passed", "")
    (remark,) = ElementTree.fromstring(junit_xml(result_of("/out"), verdict)).iter("property")
    assert remark.attrib["value"].startswith("sampled by a timer: /out, message 4 at 0.007000 s: data is 1 and 2 if")


def test_a_program_that_ends() -> None:
    verdict = Verdict(0, 0, fault="planner: ended with exit code 1: \x1b[31mKeyError\x00: 'ü'", reference=Path("x"))
    found = parsed(result_of("/a"), verdict)
    assert [outcome for outcome, _ in found.values()] == ["error", "skipped"]
    message = found["deterministic: 2 runs"][1]
    assert message == "CANNOT BE JUDGED: planner: ended with exit code 1: \ufffd[31mKeyError\ufffd: 'ü'"
    assert all(line.isprintable() for line in report_lines(result_of("/a"), verdict))


def test_most_streams_are_counted_only() -> None:
    verdict = Verdict(2, 0, reference=Path("good.mcap"), streams=[differing(f"/s{n}") for n in range(30)])
    lines = report_lines(result_of(), verdict)
    assert sum("first:" in line for line in lines) == 20 and "  … and 10 streams more" in lines


def test_bytes_of_a_type_that_is_not_read_count(tmp_path: Path) -> None:
    """Runs whose requests of a service differed were called equal: no reader has messages of such a topic."""

    def run(number: int, *messages: bytes) -> Run:
        file = OutputFile(tmp_path / f"{number}.mcap", "lab.mcap")
        stream = file.streams["/switch/requests"] = OutputStream(
            "/switch/requests", "std_srvs/srv/SetBool_Request", Qos()
        )
        for time_ns, data in enumerate(messages, 1):
            file.add(stream, time_ns, data)
        file.close()
        return Run(number, file.path, file.streams)

    def line_of(*runs: Run) -> str:
        return compare(RunResult(Path("lab.mcap"), None, list(runs))).line()

    one, same, other = run(1, b"\0\1\0\0\1", b"\0\1\0\0\2"), run(2, b"\0\1\0\0\1", b"\0\1\0\0\2"), run(3, b"\0\1\0\0\3")
    assert line_of(one, same) == "deterministic: 2 of 2 runs equal"
    assert line_of(one, other) == (
        "NOT DETERMINISTIC: run 3 differs from run 1: /switch/requests: bytes of its messages differ, and their "
        "type cannot be read"
    )
    nothing = replace(run(4), streams={})
    for run_, baseline, code, line in (
        (one, same, 0, "1 run; equal to 2.mcap"),
        (
            one,
            other,
            1,
            "DIFFERENT from 3.mcap in 1 of 1 stream (1 run): /switch/requests: bytes of its messages",
        ),
        (nothing, one, 1, "DIFFERENT from 1.mcap in 1 of 1 stream (1 run): /switch/requests, message 1 at 0"),
    ):
        verdict = compare(RunResult(Path("lab.mcap"), None, [run_]), reference=baseline.outputs)
        assert (verdict.exit_code, verdict.line()[: len(line)]) == (code, line)


def test_a_baseline_without_digests_names_what_it_cannot_compare(tmp_path: Path) -> None:
    """As of an earlier version, or a bag of ROS: the stream was called equal."""
    name, type_ = "/switch/requests", "std_srvs/srv/SetBool_Request"
    paths = [tmp_path / "one.mcap", tmp_path / "other.mcap"]
    with patch.object(outputs, "ledger_of", lambda streams: {}):
        for path, data in zip(paths, (b"\0\1\0\0\1", b"\0\1\0\0\2"), strict=True):
            file = OutputFile(path, "lab.mcap")
            stream = file.streams[name] = OutputStream(name, type_, Qos())
            file.add(stream, 1, data)
            file.close()
    result = RunResult(Path("lab.mcap"), None, [Run(1, path, file.streams)])
    verdict = compare(result, reference=paths[0])
    line = "1 run; one.mcap has none of the outputs to compare with; not compared, as their type cannot be read: "
    assert verdict.line() == line + name
    assert "not compared: its type cannot be read" in junit_xml(result, verdict).decode()
    verdict = compare(RunResult(Path("lab.mcap"), None, [Run(1, path)]), reference=paths[0])
    assert verdict.line().endswith(f"{name}, message 1 at 0.000000 s: missing")


def test_a_baseline_without_any_of_the_outputs_is_no_baseline(tmp_path: Path) -> None:
    file = OutputFile(tmp_path / "run.mcap", "lab.mcap")
    file.add(file.streams.setdefault("/out", OutputStream("/out", "std_msgs/msg/Empty", Qos())), 1, b"\0\1\0\0\0")
    file.close()
    empty = sessions.write(tmp_path / "empty.mcap", [])
    result = RunResult(Path("lab.mcap"), None, [Run(1, file.path, file.streams)])
    assert compare(result, reference=empty).fault == "empty.mcap has none of the outputs to compare with"


def test_a_stamp_is_later_and_a_number_of_that_name_differs() -> None:
    later, other = Delta(), Delta()
    later.differ("stamp", "0 ns", "5 ns")
    other.differ("stamp", 1.5, 2.5)
    texts = [Difference("/a", 1, 0, "differs", 0, delta).text(0) for delta in (later, other)]
    assert texts == [
        "/a, message 1 at 0.000000 s: its stamp is later by 5 ns",
        "/a, message 1 at 0.000000 s: stamp is 1.5 and 2.5",
    ]


@table(
    ("differing", "of_timers", "is_live", "word", "first"),
    [
        (["/a"], ["/a"], True, "sampled by a timer", "/a"),
        (["/a", "/b"], ["/a", "/b"], True, "sampled by a timer", "/a"),
        (["/a", "/b"], ["/a"], True, "different", "/b"),
        (["/a"], ["/a"], False, "different", "/a"),
        ([], ["/a"], True, "equal", ""),
    ],
)
def test_what_a_timer_samples(differing: list[str], of_timers: list[str], is_live: bool, word: str, first: str) -> None:
    """What depends on when a timer began cannot be compared with a live recording, and hides nothing else."""
    streams = [
        StreamVerdict(name, 3, 3, int(name in differing), first=Difference(name, 1, 5 + number, "differs"))
        if name in differing
        else StreamVerdict(name, 3, 3)
        for number, name in enumerate(("/a", "/b"))
    ]
    race = Race(Difference("/a", 1, 5, "differs"), "", 17_000_000, is_sample=True, streams=frozenset(of_timers))
    verdict = Verdict(3, 0, race=race, reference=Path("live.mcap"), is_live=is_live, streams=streams)
    assert (verdict.word, verdict.first.stream if verdict.first else "") == (word, first)
    assert verdict.exit_code == int(bool(differing)), "it is not what the recording has"
    assert verdict.line().startswith("SAMPLED BY A TIMER") == (word == "sampled by a timer")


@table(
    ("uses", "libraries", "variable", "is_named"),
    [
        ((2.0, 1.8), {"libscipy_openblas64_-a1.so"}, "", True),
        ((2.0, 1.8), {"libmkl_rt.so.2"}, "", True),
        ((2.0, 1.8), {"libopenblas.so"}, "OMP_NUM_THREADS", False),
        ((2.0, 0.1), {"libopenblas.so"}, "", False),  # one computes
        ((0.2, 0.2), {"libopenblas.so"}, "", False),  # nothing takes long
        ((2.0, 1.8), {"libc.so.6"}, "", False),
    ],
)
def test_threads_of_linear_algebra_are_named(
    uses: tuple[float, ...], libraries: set[str], variable: str, is_named: bool
) -> None:
    threads = [*(ThreadUse("python", "S", cpu_s) for cpu_s in uses), ThreadUse("igtl-resim", "S", 9.0)]
    with (
        patch.object(processes, "_threads", lambda _: threads),
        patch.object(processes, "_libraries", lambda _: libraries),
    ):
        process = Process("planner", ["true"], {"PATH": "/usr/bin:/bin", variable or "A": "1"}, None)
        try:
            found = faster([process])
        finally:
            process.close()
    assert bool(found) == is_named
    assert not found or found[0].startswith("planner: 2 threads compute (lib")
