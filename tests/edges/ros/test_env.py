"""The settings for large messages: applied where the user has none, kept where he has, and really in force."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from igtl_gateway.doctor.host_checks import MIN_SOCKET_BYTES
from igtl_gateway.edges.ros import env

CHOSEN_BY_USER = (
    *env.PROFILE_VARIABLES,
    env.QOS_VARIABLE,
    "FASTDDS_BUILTIN_TRANSPORTS",
    "RMW_IMPLEMENTATION",
    "MALLOC_MMAP_THRESHOLD_",
    "MALLOC_TRIM_THRESHOLD_",
    "MALLOC_TOP_PAD_",
    "GLIBC_TUNABLES",
)


@pytest.fixture(autouse=True)
def _clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in CHOSEN_BY_USER:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    # the package may be found by a path relative to the folder just left
    monkeypatch.setenv("PYTHONPATH", str(Path(env.__file__).parents[3]))


def prepare(**environ: str) -> tuple[list[str], dict[str, str], int]:
    """The lines and the environment afterwards, and how many of eight freed 6 MB blocks came from the kernel again.

    In a process of its own: the allocator's settings cannot be taken back.
    """
    script = """
import json, os, resource
from igtl_gateway.edges.ros.env import prepare_environment
lines = prepare_environment()
bytearray(6 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(8):
    bytes(bytearray(b"x") * (6 << 20))
faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(json.dumps([lines, dict(os.environ), faults * os.sysconf("SC_PAGESIZE") // (6 << 20)]))
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ, **environ}, check=True
    )
    lines, environment, fresh = json.loads(done.stdout)
    return lines, environment, fresh


def on_glibc() -> bool:
    return sys.platform.startswith("linux") and bool(os.confstr("CS_GNU_LIBC_VERSION"))


def room_for_segments() -> bool:
    shared_memory = Path("/dev/shm")
    if not shared_memory.is_dir():
        return False
    free = os.statvfs(shared_memory)
    return free.f_bavail * free.f_frsize >= 128 << 20


@pytest.mark.skipif(not on_glibc(), reason="mallopt is glibc's")
def test_allocator_keeps_large_blocks() -> None:
    lines, _, fresh = prepare()
    settings = "M_MMAP_THRESHOLD=1073741824, M_TRIM_THRESHOLD=2147483647, M_TOP_PAD=67108864"
    assert f"{settings}, M_ARENA_MAX=2" in lines[1]
    assert fresh <= 4
    lines, _, _ = prepare(MALLOC_ARENA_MAX="1")
    assert lines[1] == f"memory: freed blocks of large messages are kept (malloc: {settings})"
    lines, _, fresh_before = prepare(MALLOC_TRIM_THRESHOLD_="131072", MALLOC_MMAP_THRESHOLD_="131072")
    assert lines[1] == "malloc: kept the user's (MALLOC_MMAP_THRESHOLD_=131072)"
    assert fresh_before >= 8


@pytest.mark.skipif(not room_for_segments(), reason="needs 128 MiB of /dev/shm")
def test_profile_is_set_for_us_and_our_children() -> None:
    lines, environment, _ = prepare()
    assert "shared memory" in lines[0]
    assert {environment.get(name) for name in env.PROFILE_VARIABLES} == {str(env.PROFILE), None}
    assert environment[env.QOS_VARIABLE] == "1"
    assert prepare(**{env.QOS_VARIABLE: "0"})[1][env.QOS_VARIABLE] == "0"


@pytest.mark.skipif(not room_for_segments(), reason="needs 128 MiB of /dev/shm")
@pytest.mark.parametrize("library", ["libfastrtps.so.2.6", "libfastrtps.so.2.14.5", "libfastdds.so.3.2"])
def test_the_variable_is_the_one_that_this_fast_dds_reads(library: str, tmp_path: Path) -> None:
    """The rmw of Kilted warns in each process for which the older name is set, even beside the newer one."""
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / library).touch()
    lines, environment, _ = prepare(AMENT_PREFIX_PATH=f"/no/such/folder{os.pathsep}{tmp_path}")
    read, other = env.PROFILE_VARIABLES[:: -1 if "fastdds" in library else 1]
    assert (environment[read], environment.get(other)) == (str(env.PROFILE), None)
    assert f"({read}=" in lines[0]


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.skipif(not (on_glibc() and room_for_segments()), reason="needs 128 MiB of /dev/shm")
@pytest.mark.parametrize("subscribed", [False, True])
def test_publishers_and_subscriptions_keep_no_memory_of_the_largest_messages(subscribed: bool) -> None:
    """What 6 of 20 MiB keep: 120 MiB each with the defaults of rmw_fastrtps."""
    script = r"""
import ctypes, pathlib, re, sys, time
from igtl_gateway.edges.ros.env import prepare_environment
prepare_environment()
import rclpy
from sensor_msgs.msg import Image
from rclpy.serialization import serialize_message
def kept():
    time.sleep(0.5)
    ctypes.CDLL(None).malloc_trim(0)
    return int(re.search(r"RssAnon:\s*(\d+)", pathlib.Path("/proc/self/status").read_text())[1]) >> 10
rclpy.init()
node = rclpy.create_node("memory")
publishers = [node.create_publisher(Image, f"/memory/of{number}", 10) for number in range(6)]
received = []
if sys.argv[1] == "True":
    for number in range(6):
        node.create_subscription(Image, f"/memory/of{number}", lambda cdr: received.append(len(cdr)), 10, raw=True)
    while not all(publisher.get_subscription_count() for publisher in publishers):
        time.sleep(0.01)
cdr = serialize_message(Image(height=1, width=20 << 20, step=20 << 20, encoding="mono8", data=bytes(20 << 20)))
before = kept()
for publisher in publishers:
    publisher.publish(cdr)
while sys.argv[1] == "True" and len(received) < 6:
    rclpy.spin_once(node, timeout_sec=1)
print(kept() - before)
"""
    words = [sys.executable, "-c", script, str(subscribed)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60)
    assert int(done.stdout) < (70 if subscribed else 30)


@pytest.mark.parametrize("name", env.PROFILE_VARIABLES)
def test_profile_of_the_user_is_kept(name: str) -> None:
    lines, environment, _ = prepare(**{name: "/mine.xml"})
    assert lines[0] == f"Fast DDS profile: kept the user's ({name}=/mine.xml)"
    assert {environment.get(other) for other in env.PROFILE_VARIABLES} == {"/mine.xml", None}


def test_profile_file_in_the_working_directory_is_kept(tmp_path: Path) -> None:
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").write_text("<profiles/>")
    lines, environment, _ = prepare()
    assert "kept the user's" in lines[0]
    assert not set(env.PROFILE_VARIABLES) & set(environment)


def test_chosen_transports_and_other_middleware_are_left_alone() -> None:
    assert "kept the user's" in prepare(FASTDDS_BUILTIN_TRANSPORTS="UDPv4")[0][0]
    assert prepare(RMW_IMPLEMENTATION="rmw_cyclonedds_cpp")[0][0] == "Fast DDS profile: not for rmw_cyclonedds_cpp"


def test_tunables_of_the_user_are_kept() -> None:
    assert "kept the user's" in prepare(GLIBC_TUNABLES="glibc.malloc.arena_max=2")[0][1]


def test_no_profile_without_room_in_shared_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container, whose /dev/shm has 64 MB by default: Fast DDS would go without shared memory altogether."""

    def small(_path: Path) -> os.statvfs_result:
        return os.statvfs_result((4096, 4096, 16384, 16384, 16384, 0, 0, 0, 0, 255))

    monkeypatch.setenv("MALLOC_TOP_PAD_", "0")  # leaves the allocator of the test run alone
    monkeypatch.setattr(env, "_SHARED_MEMORY", tmp_path)
    monkeypatch.setattr(os, "statvfs", small)
    line = env.prepare_environment()[0]
    assert line.startswith("Fast DDS profile: not set, 64 MiB free in")
    assert not set(env.PROFILE_VARIABLES) & set(os.environ)


def test_packaged_profile_is_what_it_says() -> None:
    names = {"dds": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    root = ElementTree.parse(env.PROFILE).getroot()
    assert root.findtext(".//dds:segment_size", namespaces=names) == str(env._SEGMENT_BYTES)
    defined = [node.text for node in root.findall(".//dds:transport_descriptor/dds:transport_id", names)]
    used = [node.text for node in root.findall(".//dds:userTransports/dds:transport_id", names)]
    assert defined == used


def test_the_profiles_ask_for_what_doctor_asks_for() -> None:
    """The kernel's default, 208 KiB, holds three of the hundred fragments of a large image from another host."""
    names = {"dds": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    for path in (env.PROFILE, env.LOCK_STEP_PROFILE):
        asked = ElementTree.parse(path).getroot().findtext(".//dds:receiveBufferSize", namespaces=names)
        assert asked == str(MIN_SOCKET_BYTES)


def test_the_profile_for_lock_step_is_the_other_one_with_quick_acknowledgements(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spaces = {"": "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"}
    usual, quick = (ElementTree.parse(path).getroot() for path in (env.PROFILE, env.LOCK_STEP_PROFILE))
    (publisher,) = quick.findall("publisher", spaces)
    (times,) = publisher.findall("times", spaces)
    assert publisher.get("is_default_profile") == "true"
    assert [text.strip() for text in times.itertext() if text.strip()] == ["0", "2000000"]
    publisher.remove(times)
    assert [element.tag for element in quick.iter()] == [element.tag for element in usual.iter()]
    assert [element.text for element in quick.iter() if element.text and element.text.strip()] == [
        element.text for element in usual.iter() if element.text and element.text.strip()
    ]
    if room_for_segments():
        for variable in env.PROFILE_VARIABLES:
            monkeypatch.setenv(variable, str(env.PROFILE))  # inherited from a parent process
        env.prepare_environment(lock_step=True)
        assert str(env.LOCK_STEP_PROFILE) in {os.environ[name] for name in env.PROFILE_VARIABLES}


def test_a_fifo_of_another_user_in_the_shared_memory_is_not_waited_for(tmp_path: Path) -> None:
    segment = tmp_path / "fastrtps_00000000000000a1"
    segment.write_bytes(bytes(8192))
    os.mkfifo(tmp_path / f"{segment.name}_el")
    assert env.free_shared_memory(tmp_path) == 0
    assert segment.exists()


def test_memory_of_processes_that_are_gone_is_freed(tmp_path: Path) -> None:
    def segment(name: str, size: int = 8192) -> list[Path]:
        paths = [tmp_path / name, tmp_path / f"{name}_el"]
        paths[0].write_bytes(bytes(size))
        paths[1].touch()
        return paths

    dead, alive = segment("fastrtps_00000000000000a1"), segment("fastrtps_00000000000000a2")
    dead_3 = segment("fastdds_00000000000000a1")  # of Fast DDS 3
    port, other = segment("fastrtps_port7400"), segment("somebody_else")
    begun = tmp_path / "fastrtps_00000000000000a3_el"  # its process may be about to lock it
    begun.touch()
    script = (
        "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", script, str(alive[1])]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdin is not None
        process.stdout.readline()
        assert env.free_shared_memory(tmp_path) >= 8192
        assert set(tmp_path.iterdir()) == {*alive, *port, *other, begun}
        process.stdin.close()
    assert env.free_shared_memory(tmp_path) >= 8192
    assert set(tmp_path.iterdir()) == {*port, *other, begun}
    assert not any(path.exists() for path in (*dead, *dead_3))
    assert env.free_shared_memory(tmp_path / "no such folder") == 0
