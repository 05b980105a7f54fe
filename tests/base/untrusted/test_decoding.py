"""Messages of foreign types: decoded as rosbags does, refused where they would become too many objects."""

from __future__ import annotations

import builtins
import contextlib
import struct
import tracemalloc

import numpy as np
import pytest
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted import limits
from igtl_gateway.base.untrusted.decoding import MessageDecoder, new_store, register_types
from igtl_gateway.base.untrusted.definitions import parse_definition
from tests.tables import table
from tests.timing import quick

RULE = "=" * 80 + "\n"
MANY = f"p/E[] e\n{RULE}MSG: p/E\n"
HEAD = b"\0\1\0\0"


def decoder(text: str) -> MessageDecoder:
    return MessageDecoder(lambda _: text)


def test_a_store_reads_and_writes_as_that_of_rosbags() -> None:
    name, known, ours = "sensor_msgs/msg/CameraInfo", get_typestore(Stores.ROS2_JAZZY), new_store()
    register_types(ours, parse_definition(known.generate_msgdef(name, ros_version=2)[0], name))
    zero = ours.types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True)
    data = ours.serialize_cdr(zero, "sensor_msgs/msg/RegionOfInterest")
    same = known.deserialize_cdr(data, "sensor_msgs/msg/RegionOfInterest")
    assert (same.x_offset, same.do_rectify) == (1, True)  # type: ignore[attr-defined]
    assert ours.deserialize_cdr(data, "sensor_msgs/msg/RegionOfInterest") == zero
    ros1 = ours.serialize_ros1(zero, "sensor_msgs/msg/RegionOfInterest")
    assert bytes(ours.ros1_to_cdr(ros1, "sensor_msgs/msg/RegionOfInterest")) == bytes(data)


def test_messages_are_decoded_by_the_files_own_definition() -> None:
    assert decoder("float64 x\n").decode("std_msgs/msg/String", HEAD + struct.pack("<d", 1.5)).x == 1.5
    with pytest.raises(SerdeError):
        decoder("float64 x\n").decode("std_msgs/msg/String", HEAD)
    with pytest.raises(DamagedRecording, match="p/msg/A: found no definition"):
        decoder("").decode("p/msg/A", b"")


def test_a_bad_definition_is_parsed_once() -> None:
    asked: list[str] = []

    def text(name: str) -> str:
        asked.append(name)
        return "p/A a\n"

    one = MessageDecoder(text)
    for _ in range(3):
        with pytest.raises(DamagedRecording, match="inside itself"):
            one.decode("p/msg/A", b"")
    assert asked == ["p/msg/A"]


@table(
    ("text", "data"),
    [
        (MANY, struct.pack("<I", 8_000_000) + bytes(8_000_000)),
        (MANY, struct.pack("<I", 0xFFFF_FFFF) + bytes(1_000_000)),
        ("string[] s\n", struct.pack("<I", 1_000_000) + (struct.pack("<I", 1) + bytes(4)) * 1_000_000),
        (f"float64[] x\np/E[] e\n{RULE}MSG: p/E\nuint8[] x\n", struct.pack("<II", 0, 1_000_000) + bytes(4_000_000)),
    ],
)
@table("order", [1, 0])
def test_a_message_of_many_objects_is_refused_before_it_is_decoded(text: str, data: bytes, order: int) -> None:
    if not order:
        data = struct.pack(">I", struct.unpack_from("<I", data)[0]) + data[4:]
    one = decoder(text)
    tracemalloc.start()
    with quick(), pytest.raises(LimitExceeded, match=r"a message of p/msg/A: found more than 200000 elements"):
        one.decode("p/msg/A", bytes((0, order, 0, 0)) + data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50 << 20


def test_large_messages_of_few_objects_are_decoded() -> None:
    known = get_typestore(Stores.ROS2_JAZZY)
    name = "sensor_msgs/msg/PointCloud2"
    one = decoder(known.generate_msgdef(name, ros_version=2)[0])
    make = {short: known.types[f"{package}/msg/{short}"] for package, short in (
        ("builtin_interfaces", "Time"), ("std_msgs", "Header"), ("sensor_msgs", "PointField"))}  # fmt: skip
    head = make["Header"](make["Time"](1, 2), "f")
    field = make["PointField"]("x", 0, 7, 1)
    cloud = known.types[name](head, 1, 1_000_000, [field], False, 4, 4, np.zeros(4_000_000, np.uint8), True)
    data = bytes(known.serialize_cdr(cloud, name))
    assert one.decode(name, data).data.size == 4_000_000


def test_the_definitions_of_a_file_have_a_limit_together() -> None:
    text = "".join(f"int8 x{i}\n" for i in range(2500))
    one = decoder(text)
    one.store("p/msg/A")
    one.store("p/msg/B")
    with pytest.raises(LimitExceeded, match="definitions of a file: found 7503, expected at most 6000"):
        one.store("p/msg/C")


PAYLOAD = "__import__('builtins').injected = 1"


@table(
    "fields",
    [
        "int8[] class\n",
        "int8 None\n",
        "int8 self\nint8 cls\nint8 typestore\nint8 pos\n",
        "int8 sys\nint8 numpy\nstring dataclass\nint8 ClassVar\nint8 T\nint8 np\n",
        f'string X="\\"\n{PAYLOAD}\n',
        f"string X='''\"\"\"\n{PAYLOAD}\n",
        f'string X="""; {PAYLOAD} #\n',
        f"string X=\\'; {PAYLOAD}; \\'\n",
        f"string X={PAYLOAD}\n",
        f"int8 x {PAYLOAD}\n",
        f"int8 x\r{PAYLOAD}\n",
        f"int8 x\u2028{PAYLOAD}\n",
        f"int8 x\n{RULE}MSG: p/B\n{PAYLOAD}\n",
    ],
)
def test_names_and_values_of_python_are_no_code(fields: str) -> None:
    with contextlib.suppress(DamagedRecording, SerdeError):
        decoder(fields).decode("p/msg/A", HEAD + bytes(64))
    assert not hasattr(builtins, "injected")


def test_the_limit_of_elements_can_be_set() -> None:
    data = HEAD + struct.pack("<I", 300_000) + bytes(300_000)
    with limits.limits_in_force(limits.parse_limits(["count=400000"])):
        assert len(decoder(MANY).decode("p/msg/A", data).e) == 300_000


@pytest.mark.parametrize("inner", ["lab_msgs/In value", "lab_msgs/In[1] value"])
def test_bytes_that_fast_dds_leaves_behind_empty_sequences_are_no_damage(inner: str) -> None:
    """Two empty sequences of 64-bit numbers: as `rclpy.serialization` writes a parameter event."""
    parts = "string name\n{}uint8 last\n", "\n" + 80 * "=" + "\nMSG: lab_msgs/In\n{}"
    text = parts[0].format(inner + "\n") + parts[1].format("int64[] whole\nfloat64[] real\n")
    body = struct.pack("<I4sIIB", 4, b"abc\0", 0, 0, 7)
    decoder = MessageDecoder(lambda _: text)
    for behind in (b"", bytes(3), bytes(8), b"\x80\x25\xf5\x2b\x64\x7f\0\0", bytes(len(body))):
        message = decoder.decode("a/msg/B", b"\0\1\0\0" + body + behind)
        assert (message.name, message.last) == ("abc", 7)
    with pytest.raises(SerdeError, match="size mismatch"):
        decoder.decode("a/msg/B", b"\0\1\0\0" + body + bytes(2 * len(body)))
    without = MessageDecoder(lambda _: parts[0].format("") + "int32[] whole\nuint8[] real\n")
    with pytest.raises(SerdeError, match="size mismatch"):
        without.decode("a/msg/C", b"\0\1\0\0" + struct.pack("<I4sB3xII", 4, b"abc\0", 7, 0, 0) + bytes(8))
    with pytest.raises(SerdeError):
        decoder.decode("a/msg/B", b"\0\1\0\0\xff" + bytes(20))
