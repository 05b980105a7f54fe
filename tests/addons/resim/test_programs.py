"""Programs of every kind: the same recording gives the same outputs in each of 5 runs."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from igtl_gateway.addon.reading import Kind, Qos
from igtl_gateway.addons.resim.engine import Clocks, Program, ResimOptions, RunResult, run
from igtl_gateway.addons.resim.races import find_race
from igtl_gateway.addons.resim.verdict import Race, compare
from igtl_gateway.cli import main as gateway
from tests.addons.resim import sessions
from tests.addons.resim.runs import PROGRAMS, RUNS, compiled, judged, program, published, strings
from tests.places import FIXTURES

pytestmark = [pytest.mark.ros, pytest.mark.skipif(not find_spec("rclpy"), reason="needs ROS 2")]


def test_a_node_with_one_thread(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(200))
    result, verdict = judged(recording, tmp_path, "single")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.roles and result.roles.inputs == {"/in": 200}
    said = strings(result.runs[0].outputs, "/out")
    assert len([text for text in said if text.startswith("got")]) == 200
    times = [int(text.rpartition(" ")[2]) for text in said if text.startswith("tick")]
    start_ns = result.runs[0].start_ns
    assert times == [start_ns + 10**9 * (number + 1) for number in range(len(times))]
    assert len(times) >= 3


def test_several_threads_with_reentrant_callbacks(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(100))
    result, verdict = judged(recording, tmp_path, "multithreaded")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    said = strings(result.runs[0].outputs, "/out")
    assert sum(text.startswith("got") for text in said) == sum(text.startswith("later") for text in said) == 100


@pytest.mark.parametrize("clock", ["", " coarse"])
def test_a_loop_of_asyncio_that_polls(tmp_path: Path, clock: str) -> None:
    """Each ``spin_once(timeout_sec=0)`` triggers a guard condition; messages and timers come nevertheless."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(10)[:10])
    result, verdict = judged(recording, tmp_path, f"asynchronous{clock}", runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    said = [text.split()[0] for text in strings(result.runs[0].outputs, "/out")]
    assert said.count("tick") == (result.runs[0].end_ns - result.runs[0].start_ns) // 100_000_000
    assert [text for text in said if text != "tick"][:9] == [f"m{number}" for number in range(9)]


def test_messages_have_the_length_that_is_written(tmp_path: Path) -> None:
    """Fast DDS estimates more behind empty sequences of doubles, which no decoder expects."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(3))
    result, _ = judged(recording, tmp_path, "planted joints", runs=1)
    messages = [data for _, data in published(result.runs[0].outputs, "/joints")]
    nothing = np.empty(0)
    content = sessions.message(
        "sensor_msgs/msg/JointState",
        header=sessions.message("std_msgs/msg/Header", stamp=sessions.stamp(-sessions.START_NS), frame_id="base"),
        name=["a"], position=np.array([1.0]), velocity=nothing, effort=nothing,
    )  # fmt: skip
    assert messages == [sessions.cdr("sensor_msgs/msg/JointState", content)] * 3


def test_threads_have_the_order_of_their_creation_when_numbers_of_processes_begin_anew(tmp_path: Path) -> None:
    """Of two threads that sleep to the same time, the older one is first, although its number is the higher one."""
    namespace = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--mount-proc"]
    if not shutil.which("unshare") or subprocess.run([*namespace, "true"], check=False).returncode:
        pytest.skip("needs namespaces of users and processes")
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(5))
    for which in ("usual", "wrap"):
        command = ["igtl_gateway", "resim", str(recording), "--runs", "1", "--record", str(tmp_path / f"{which}.mcap")]
        program = [sys.executable, str(PROGRAMS / "threads.py"), which]
        subprocess.run([*namespace, sys.executable, "-m", *command, "--", *program], check=True)
    said = strings(tmp_path / "usual.mcap", "/out")
    assert said == [f"{name} {number}" for number in range(10) for name in ("first", "second")]
    assert strings(tmp_path / "wrap.mcap", "/out") == said


def test_a_service_and_its_client_in_two_programs(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(60))
    result, verdict = judged(recording, tmp_path, "caller", "switch", latency_ns=1_000_000)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    answers = strings(result.runs[0].outputs, "/answers")
    # it waits for the service for 0.25 s first, and the last ten messages of that time wait for it
    names = [int(text.split(":")[0][1:]) for text in answers]
    assert names == list(range(names[0], 60))
    assert answers[1].split()[1:3] == ["True", "on"]
    assert answers[20].split()[2] == "changed"  # by the service of its parameters
    # the request arrives a millisecond after the message, and the clock there shows it
    arrived = [int(text.split(" at ")[1].split()[0]) for text in answers[20:]]
    sent = [time_ns for time_ns, _ in published(recording, "/in")][names[20] :]
    assert [after - before for before, after in zip(sent, arrived, strict=True)] == [1_000_000] * len(sent)


@pytest.mark.skipif(not find_spec("test_msgs"), reason="needs test_msgs")
def test_an_action_of_rclpy(tmp_path: Path) -> None:
    """Goals that succeed, are cancelled, are rejected; in feedback, whose definition only the .action file has."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(10))
    result, verdict = judged(recording, tmp_path, "fibonacci server", "fibonacci client")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert len({one.streams["/drive/_action/status"].digest for one in result.runs}) == 1  # goal ids are random
    said = strings(good := result.runs[0].outputs, "/out")
    assert [sum(f"accepted={each}" in text for text in said) for each in (True, False)] == [8, 2]
    ends = [text.split()[1:3] for text in said if "[" in text]
    assert sorted(ends) == [["4", "[0,"]] * 6 + [["5", "[0,"]] * 2  # succeeded, cancelled
    (tmp_path / "wrong").mkdir()
    names = ["fibonacci server wrong", "fibonacci client"]
    _, verdict = judged(recording, tmp_path / "wrong", *names, runs=1, reference=good)
    assert "/drive/_action/feedback, message " in verdict.line()
    assert "feedback.sequence[2] is 1 and 2" in verdict.line()


@pytest.mark.skipif(not find_spec("test_msgs"), reason="needs test_msgs")
def test_an_action_whose_server_is_missing(tmp_path: Path) -> None:
    """By default, a fault that names the action; ``--without`` takes its name, and its requests have no answer."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(3))
    _, verdict = judged(recording, tmp_path, "fibonacci client", runs=1)
    assert verdict.fault == "action /drive: no program is its server; --without TOPIC runs the programs without it"
    result, _ = judged(recording, tmp_path, "fibonacci client", runs=1, without=("/drive",))
    assert result.runs[0].unserved == {"/drive/_action/send_goal": 3}


def test_a_lifecycle_node_and_its_manager(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(150))
    result, verdict = judged(recording, tmp_path, "lifecycle", "manager")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    times = [time_ns for time_ns, _ in published(result.runs[0].outputs, "/out")]
    assert times
    assert times[-1] - result.runs[0].start_ns < 2.5e9  # deactivated after two seconds


def test_transforms_with_a_listener_in_a_thread_of_its_own(tmp_path: Path) -> None:
    rows = [(ns, "/tf", sessions.TF, sessions.transforms(each)) for ns, _, _, each in sessions.poses(200)]
    recording = sessions.write(tmp_path / "in.mcap", rows)
    result, verdict = judged(recording, tmp_path, "frames")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.roles and result.roles.inputs == {"/tf": 200}
    assert len(published(result.runs[0].outputs, "/tf")) == 19
    race = race_of(result, "frames")
    assert race and race.is_sample  # what its timer publishes has another time then: stated, no fault


def test_images_and_poses_in_pairs(tmp_path: Path) -> None:
    rows = [*sessions.poses(200), *sessions.images(40)]
    recording = sessions.write(tmp_path / "in.mcap", rows)
    result, verdict = judged(recording, tmp_path, "pairs")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert len(strings(result.runs[0].outputs, "/pairs")) == 40


def test_a_program_in_c(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(100))
    echo = Program((str(compiled("echo", tmp_path)),), "echo")
    result = run(recording, [echo], ResimOptions(runs=RUNS), tmp_path)
    assert compare(result).line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert strings(result.runs[0].outputs, "/out")[-1].startswith("m99 100 ")


def test_what_one_publishes_the_other_receives(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(60))
    result, verdict = judged(recording, tmp_path, "relay /in /middle", "relay /middle /last", latency_ns=500_000)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    inputs = [time_ns for time_ns, _ in published(recording, "/in")]
    last = [time_ns for time_ns, _ in published(result.runs[0].outputs, "/last")]
    assert [after - before for before, after in zip(inputs, last, strict=True)] == [500_000] * 60


def test_latched_inputs_reach_subscriptions_that_come_later(tmp_path: Path) -> None:
    rows = sessions.texts(3, "/map")
    rows += [(2_000_000_000, "/in", *row[2:]) for row in sessions.texts(1)[:1]]
    recording = sessions.write(tmp_path / "in.mcap", rows, qos={"/map": Qos(1, True, True)})
    result, verdict = judged(recording, tmp_path, "late", runs=2)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    assert strings(result.runs[0].outputs, "/out") == ["map m2", "in m0"]


def test_recorded_topics_are_in_the_graph_before_the_program_asks_for_them(tmp_path: Path) -> None:
    rows = [*sessions.texts(20), *sessions.texts(20, "/own_in")]
    recording = sessions.write(tmp_path / "in.mcap", rows, kind=Kind.ROS_IN)
    result, verdict = judged(recording, tmp_path, "finder", runs=2, lead_ns=1_000_000_000)
    assert verdict.line() == "deterministic: 2 of 2 runs equal"
    assert strings(result.runs[0].outputs, "/out") == [
        "/in ['std_msgs/msg/String'] 1",
        "/own_in ['std_msgs/msg/String'] 1",  # its own: what a program publishes, the recording does not drive
        *(f"m{number}" for number in range(20)),
    ]
    first_ns, _ = published(result.runs[0].outputs, "/out")[0]
    assert first_ns - result.runs[0].start_ns == -900_000_000


def test_a_node_of_a_scenario_as_it_is(tmp_path: Path) -> None:
    """The first four seconds: those of lego and star compute for a second and for three in each run."""
    recording = tmp_path / "in.mcap"
    assert not gateway(["slice", str(FIXTURES / "ultrasound.mcap"), "-o", str(recording), "--start", "0", "--end", "4"])
    names = ["actor ultrasound navigator"]
    result, verdict = judged(recording, tmp_path, *names, clocks=Clocks.SESSION, lead_ns=1_000_000_000)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.runs[0].streams["/ultrasound/needle"].messages == 1


@pytest.mark.parametrize(
    ("scenario", "actors"),
    [("ultrasound", ["navigator"]), ("lego", ["lego_robot"]), ("star", ["star_sensors", "star_robot"])],
)
def test_nodes_of_scenarios_as_they_are(tmp_path: Path, scenario: str, actors: list[str]) -> None:
    names = [f"actor {scenario} {actor}" for actor in actors]
    recording = FIXTURES / f"{scenario}.mcap"
    result, verdict = judged(recording, tmp_path, *names, clocks=Clocks.SESSION, lead_ns=1_000_000_000)
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert result.runs[0].messages > 5


def test_the_quality_of_service_of_the_recording_applies(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(3), qos={"/in": Qos(10, False, False)})
    result, verdict = judged(recording, tmp_path, "single", runs=1)
    why = "reliability (best effort offered, reliable requested)"
    assert verdict.fault == f"/in: not received: {why}; --without TOPIC runs the programs without it"
    result, verdict = judged(recording, tmp_path, "single", runs=1, without=("/in",))
    assert verdict.exit_code == 0
    assert result.runs[0].refused == {"/in": why}
    assert result.runs[0].delivered == {}


@pytest.mark.parametrize(
    ("what", "first"),
    [
        ("wall", "data is 'm20 at 1700000000"),
        ("chance", "data is 'm20 0."),
        ("hashed", "data is 'm"),
        ("race", 'data is "m'),
    ],
)
def test_what_is_not_the_same_in_every_run_is_found(tmp_path: Path, what: str, first: str) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    _, verdict = judged(recording, tmp_path, f"planted {what}", runs=5)
    assert verdict.exit_code == 1
    assert verdict.first
    assert verdict.first.stream == "/out"
    # the order of a set, or of two threads, may be the same in all runs by chance
    assert verdict.first.number in (range(21, 41) if what in ("hashed", "race") else (21,))
    assert first in verdict.line()


def test_the_wall_clock_can_be_session_time(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(30))
    _, verdict = judged(recording, tmp_path, "planted wall", runs=2, clocks=Clocks.SESSION)
    assert verdict.exit_code == 0


def test_waits_of_c_end_in_session_time(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, verdict = judged(recording, tmp_path, "planted waits")
    assert verdict.line() == f"deterministic: {RUNS} of {RUNS} runs equal"
    assert strings(result.runs[0].outputs, "/out")[20] == "m20 [0, 3.0, 0, 3.0, 0, 3.0, 0, 3.0, -1, 3.0]"
    assert result.runs[0].remarks == []


def on_a_grid(path: Path, period_ns: int, count: int = 40) -> Path:
    """A recording with strings at equal distances."""
    rows = [(period_ns * number, *row[1:]) for number, row in enumerate(sessions.texts(count), 1)]
    return sessions.write(path, rows)


def test_a_timer_that_races_a_topic(tmp_path: Path) -> None:
    """An input and a tick of a timer of 7 ms are at the same time, and what the input causes depends on their order."""
    recording = on_a_grid(tmp_path / "in.mcap", 7_000_000)
    result, verdict = judged(recording, tmp_path, "planted timer", runs=2)
    verdict.race = race_of(result, "planted", "timer")
    place = "/out, message 21 at 0.140000 s: data is 'm20 19' and 'm20 20'"
    assert verdict.line() == (
        f"NOT DETERMINISTIC: a timer races /in: {place} if the timer is first; "
        "likely cause: a timer and an input at the same time, whose order is chosen"
    )
    assert (verdict.exit_code, verdict.is_deterministic) == (1, False)
    assert verdict.first and (verdict.first.stream, verdict.first.number) == ("/out", 21)
    verdict.permits_races = True
    assert verdict.line() == f"deterministic: 2 of 2 runs equal, but a timer races /in: {place} if the timer is first"
    assert (verdict.exit_code, verdict.is_deterministic) == (0, True)
    _, verdict = judged(recording, tmp_path, "planted timer", runs=2, swap_ties=True)
    assert verdict.first and (verdict.first.stream, verdict.first.number) == ("/out", 21)
    assert verdict.line().endswith("data is 'm20 19' and 'm20 20'")


def test_a_timer_that_is_at_the_time_of_an_input_now_and_then(tmp_path: Path) -> None:
    """A timer of 7 ms passes on what inputs of each 10 ms set: at the tenth tick, before or after the eighth?"""
    result, verdict = judged(on_a_grid(tmp_path / "in.mcap", 10_000_000), tmp_path, "planted samples", runs=2)
    verdict.race = race_of(result, "planted", "samples")
    place = "/out, message 18 at 0.070000 s: data is '8 by tick 10' and '7 by tick 10'"
    assert f"NOT DETERMINISTIC: a timer races /in: {place} if the timer is first" in verdict.line()


@pytest.mark.parametrize(
    ("what", "remark", "place"),
    [
        (
            "timer",
            ", but an output at /in depends on when the programs start: {}",
            "/out, message 21 at 0.409696 s: data is 'm20 58' and 'm20 61' if the programs start 17.4 ms earlier",
        ),
        (
            "samples",
            " (sampled by a timer: {})",
            "/out, message 2 at 0.007000 s: data is '1 by tick 1' and '0 by tick 1' "
            "if the programs start 17.4 ms earlier",
        ),
    ],
)
def test_a_timer_that_is_never_at_the_time_of_an_input(tmp_path: Path, what: str, remark: str, place: str) -> None:
    """Starting earlier only moves its ticks: a remark, or a failure for those who ask for it."""
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(40))
    result, verdict = judged(recording, tmp_path, f"planted {what}", runs=2)
    verdict.race = race_of(result, "planted", what)
    assert (verdict.exit_code, verdict.is_deterministic) == (0, True)
    assert verdict.line() == f"deterministic: 2 of 2 runs equal{remark.format(place)}"
    verdict.wants_any_start = True
    assert verdict.exit_code == 1
    assert verdict.line().startswith("NOT DETERMINISTIC: ") and place in verdict.line()


def race_of(result: RunResult, *words: str) -> Race | None:
    (folder := result.runs[0].outputs.with_name("earlier")).mkdir()
    return find_race(result, [program(*words)], ResimOptions(), folder)


def test_use_sim_time_follows_the_session(tmp_path: Path) -> None:
    recording = sessions.write(tmp_path / "in.mcap", sessions.texts(60))
    arguments = "--ros-args -p use_sim_time:=true"
    result, verdict = judged(recording, tmp_path, f"single {arguments}", runs=2)
    assert verdict.exit_code == 0
    assert result.roles and set(result.roles.inputs) == {"/in", "/clock"}
    said = strings(result.runs[0].outputs, "/out")
    shown = [int(text.rpartition(" ")[2]) for text in said if text.startswith("got")]
    sent = [time_ns for time_ns, _ in published(recording, "/in")]
    start_ns = result.runs[0].start_ns
    # of a clock of 100 Hz
    assert shown == [start_ns + (time_ns - start_ns) // 10_000_000 * 10_000_000 for time_ns in sent]
    assert sum(text.startswith("tick") for text in said) == 2
