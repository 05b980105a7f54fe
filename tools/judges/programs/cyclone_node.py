"""A foreign ROS 2 node on another vendor's DDS: Eclipse Cyclone DDS.  Nothing of igtl_gateway is imported here.

It takes the commands of ``tests/integration/ros_client.py`` but ``call``; ``reliable`` false asks for best effort.
Its types are made from the definitions of messages, with names as ROS has them on DDS.

usage: cyclone_node.py FOLDER … NODE_NAME

The folders have definitions of messages, as ``PACKAGE/msg/NAME.msg``.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TIMEOUT_S = 20.0
#: The field of a message without fields.
NOTHING = "structure_needs_at_least_one_member"
BYTES = ("octet", "byte", "char", "uint8")
NUMBERS = {name: getattr(types, name) for name in "int8 int16 uint16 int32 uint32 int64 uint64 float32 float64".split()}
BASES: dict[str, Any] = {**NUMBERS, **dict.fromkeys(BYTES, types.uint8), "bool": bool, "string": str}

_printing = threading.Lock()


def say(value: dict[str, Any]) -> None:
    with _printing:
        print(json.dumps(value), flush=True)


class Types:
    """Cyclone's classes of messages, and JSON values as their instances and back."""

    def __init__(self, folders: list[str]) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        found: dict[str, Any] = {}
        for path in (path for folder in folders for path in Path(folder).glob("*/msg/*.msg")):
            found |= get_types_from_msg(path.read_text(), f"{path.parts[-3]}/msg/{path.stem}")
        self.store.register(found)
        self._made: dict[str, Any] = {}

    def fields(self, name: str) -> list[tuple[str, Any]]:
        return list(self.store.fielddefs[name][1])

    def of(self, name: str) -> Any:
        if name not in self._made:
            package, _, own = name.split("/")
            members = {each: self._kind(kind) for each, kind in self.fields(name)}
            self._made[name] = make_idl_struct(f"{own}_", f"{package}.msg.dds_.{own}_", members)
        return self._made[name]

    def _kind(self, kind: Any) -> Any:
        what, of = kind
        if what == Nodetype.NAME:
            return self.of(of)
        if what == Nodetype.BASE:
            return types.bounded_str[of[1]] if of[1] else BASES[of[0]]
        element, size = self._kind(of[0]), of[1]
        if what == Nodetype.ARRAY:
            return types.array[element, size]
        return types.sequence[element, size] if size else types.sequence[element]

    def make(self, name: str, fields: dict[str, Any]) -> Any:
        usual = {"w": 1.0} if name == "geometry_msgs/msg/Quaternion" else {}
        return self.of(name)(
            **{each: self._value(kind, (usual | fields).get(each)) for each, kind in self.fields(name)}
        )

    def _value(self, kind: Any, value: Any) -> Any:
        what, of = kind
        if what == Nodetype.NAME:
            return self.make(of, value or {})
        if what == Nodetype.BASE:
            value = bytes.fromhex(value["hex"])[0] if isinstance(value, dict) else value
            return value if value is not None else {"string": "", "bool": False}.get(of[0], 0)
        if isinstance(value, dict):
            return list(bytes.fromhex(value["hex"]))
        if value is None:
            value = [None] * of[1] if what == Nodetype.ARRAY else []
        return [self._value(of[0], one) for one in value]

    def plain(self, message: Any, name: str) -> dict[str, Any]:
        there = [(each, kind) for each, kind in self.fields(name) if each != NOTHING]
        return {each: self._plain(kind, getattr(message, each)) for each, kind in there}

    def _plain(self, kind: Any, value: Any) -> Any:
        what, of = kind
        if what == Nodetype.NAME:
            return self.plain(value, of)
        if what == Nodetype.BASE:
            return {"hex": bytes([value]).hex()} if of[0] in ("byte", "octet") else value
        element = of[0]
        if what == Nodetype.SEQUENCE and element[0] == Nodetype.BASE and element[1][0] in BYTES:
            return {"hex": bytes(value).hex()}
        return [self._plain(element, one) for one in value]


def quality(command: dict[str, Any]) -> Qos:
    reliable = Policy.Reliability.Reliable(duration(seconds=10))
    return Qos(
        reliable if command.get("reliable", True) else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if command.get("latched") else Policy.Durability.Volatile,
        Policy.History.KeepLast(command.get("depth", 100)),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


class Client:
    """A participant with its readers and writers."""

    def __init__(self, folders: list[str]) -> None:
        self._participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        self._types = Types(folders)
        self._readers: list[tuple[str, str, Any]] = []
        self._writers: dict[str, tuple[Any, str]] = {}
        self._last: dict[str, Any] = {}
        threading.Thread(target=self._take, daemon=True).start()

    def _take(self) -> None:
        while True:
            for topic, name, reader in self._readers.copy():
                for message in reader.take(N=100):
                    if hasattr(message, "__dataclass_fields__"):  # else: the end of a writer
                        say({"topic": topic, "message": self._types.plain(message, name)})
            time.sleep(0.002)

    def _topic(self, command: dict[str, Any]) -> Topic[Any]:
        return Topic(self._participant, f"rt{command['topic']}", self._types.of(command["type"]))

    def subscribe(self, command: dict[str, Any]) -> None:
        reader = DataReader(self._participant, self._topic(command), qos=quality(command))
        self._readers.append((command["topic"], command["type"], reader))

    def advertise(self, command: dict[str, Any]) -> None:
        writer = DataWriter(self._participant, self._topic(command), qos=quality(command))
        self._writers[command["topic"]] = (writer, command["type"])

    def readers(self, command: dict[str, Any]) -> None:
        topic, deadline = command["topic"], time.monotonic() + TIMEOUT_S
        while (found := len(self._writers[topic][0].get_matched_subscriptions())) < command["count"]:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{topic}: {found} readers, expected {command['count']}")
            time.sleep(0.005)

    def publish(self, command: dict[str, Any]) -> None:
        writer, name = self._writers[command["topic"]]
        self._last[command["topic"]] = self._types.make(name, command["fields"])
        writer.write(self._last[command["topic"]])

    def again(self, command: dict[str, Any]) -> None:
        message = self._last[command["topic"]]
        message.header.stamp.sec = command["sec"]
        self._writers[command["topic"]][0].write(message)


def main() -> None:
    client = Client(sys.argv[1:-1])
    for line in sys.stdin:
        command = json.loads(line)
        try:
            getattr(client, command["do"])(command)
            say({"done": command["do"]})
        except Exception as error:  # reported to the judge that gave the command
            say({"failed": f"{command['do']} {command['topic']}: {type(error).__name__}: {error}"})


if __name__ == "__main__":
    main()
