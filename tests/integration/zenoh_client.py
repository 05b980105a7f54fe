"""A foreign ROS 2 node without ROS: plain Zenoh, and CDR by rosbags.  Nothing of igtl_gateway is imported here.

It takes the commands of ``ros_client``, so that the tests of one run with the other.

usage: zenoh_client.py ENDPOINT FOLDER … NODE_NAME

The folders have definitions of messages and services, as ``PACKAGE/msg/NAME.msg``.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
import zenoh
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TIMEOUT_S = 60.0
#: The field of a message without fields.
NOTHING = "structure_needs_at_least_one_member"
INFO = "service_msgs/msg/ServiceEventInfo"
NUMBERS = "int8 uint8 int16 uint16 int32 uint32 int64 uint64".split()
#: type_id of a field (REP-2016).
TYPE_IDS = {name: number for number, name in enumerate(NUMBERS, 2)} | {"float32": 10, "float64": 11, "bool": 15}
TYPE_IDS |= {"octet": 16, "byte": 16, "string": 17, "char": 3}

_printing = threading.Lock()
Fields = list[tuple[str, Any]]


def say(value: dict[str, Any]) -> None:
    with _printing:
        print(json.dumps(value), flush=True)  # noqa: T201 (the protocol)


class Types:
    """Definitions, hashes and CDR of all types."""

    def __init__(self, folders: list[str]) -> None:
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self._folders = [Path(folder) for folder in folders]
        found: dict[str, Any] = {}
        for path in (path for folder in self._folders for path in folder.glob("*/msg/*.msg")):
            found |= get_types_from_msg(path.read_text(), f"{path.parts[-3]}/msg/{path.stem}")
        self.store.register(found)
        self.services: set[str] = set()

    def service(self, name: str) -> None:
        """Read the two halves of a service as messages."""
        if name in self.services:
            return
        package, _, own = name.split("/")
        (path,) = (found for folder in self._folders for found in folder.glob(f"{package}/srv/{own}.srv"))
        halves = path.read_text().split("---\n")
        for part, text in zip(("Request", "Response"), halves, strict=True):
            self.store.register(get_types_from_msg(text, f"{package}/msg/{own}_{part}"))
        self.services.add(name)

    def fields(self, name: str) -> Fields:
        """The fields of a message, of a service, or of its parts."""
        if name in self.services:
            parts = ("request", "response", "event")
            return [(f"{part}_message", (Nodetype.NAME, f"{name}_{part.title()}")) for part in parts]
        service = name.rpartition("_")[0]
        if service in self.services and name.endswith("_Event"):
            one = [(part.lower(), (Nodetype.NAME, f"{service}_{part}")) for part in ("Request", "Response")]
            return [("info", (Nodetype.NAME, INFO)), *((part, (Nodetype.SEQUENCE, (kind, 1))) for part, kind in one)]
        return list(self.store.fielddefs[name.replace("/srv/", "/msg/")][1])

    def hash(self, name: str) -> str:
        """REP-2016, by its text."""
        described: dict[str, Any] = {}
        waiting = [name]
        while waiting:
            one = waiting.pop()
            if one not in described:
                described[one] = {"type_name": one, "fields": [self._field(*field) for field in self.fields(one)]}
                waiting += [each["type"]["nested_type_name"] for each in described[one]["fields"]]
                waiting = [each for each in waiting if each]
        others = [described[one] for one in sorted(described) if one != name]
        text = json.dumps({"type_description": described[name], "referenced_type_descriptions": others})
        return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"

    @staticmethod
    def _field(name: str, kind: Any) -> dict[str, Any]:
        add, size, element = 0, 0, kind
        if kind[0] == Nodetype.ARRAY:
            element, size = kind[1]
            add = 48
        elif kind[0] == Nodetype.SEQUENCE:
            element, size = kind[1]
            add = 96 if size else 144
        nested = element[1] if element[0] == Nodetype.NAME else ""
        base, bound = ("", 0) if nested else element[1]
        number = 1 if nested else 21 if base == "string" and bound else TYPE_IDS[base]
        kinds = {"type_id": number + add, "capacity": size, "string_capacity": bound, "nested_type_name": nested}
        return {"name": name, "type": kinds}

    def make(self, name: str, fields: dict[str, Any]) -> Any:
        """A message with these fields; others have their defaults."""
        usual = {"w": 1.0} if name == "geometry_msgs/msg/Quaternion" else {}
        values = {each: self._value(kind, (usual | fields).get(each)) for each, kind in self.fields(name)}
        return self.store.types[name](**values)

    def _value(self, kind: Any, value: Any) -> Any:
        what, of = kind
        if what == Nodetype.NAME:
            return self.make(of, value or {})
        if what == Nodetype.BASE:
            value = bytes.fromhex(value["hex"])[0] if isinstance(value, dict) else value
            return value if value is not None else {"string": "", "bool": False}.get(of[0], 0)
        element, size = of
        if isinstance(value, dict):  # bytes
            value = list(bytes.fromhex(value["hex"]))
        if value is None:
            value = [None] * size if what == Nodetype.ARRAY else []
        values = [self._value(element, one) for one in value]
        if element[0] == Nodetype.NAME or element[1][0] == "string":
            return values
        return np.array(values, {"octet": "uint8", "byte": "uint8", "char": "uint8"}.get(element[1][0], element[1][0]))

    def plain(self, message: Any, name: str) -> dict[str, Any]:
        """A message as JSON values, as ``ros_client`` has them."""
        there = [(each, kind) for each, kind in self.fields(name) if each != NOTHING]
        return {each: self._plain(kind, getattr(message, each)) for each, kind in there}

    def _plain(self, kind: Any, value: Any) -> Any:
        what, of = kind
        if what == Nodetype.NAME:
            return self.plain(value, of)
        if what == Nodetype.BASE:
            return {"hex": bytes([value]).hex()} if of[0] in ("byte", "octet") else value
        element = of[0]
        if element[0] == Nodetype.NAME or element[1][0] == "string":
            return [self._plain(element, one) for one in value]
        if what == Nodetype.SEQUENCE and value.dtype == np.uint8:
            return {"hex": value.tobytes().hex()}
        return value.tolist()


class Client:
    """A session with the tokens of a node."""

    def __init__(self, name: str, endpoint: str, folders: list[str]) -> None:
        config = zenoh.Config()
        for key, value in (("mode", "client"), ("connect/endpoints", [endpoint]), ("timestamping/enabled", True)):
            config.insert_json5(key, json.dumps(value))
        self.session: Any = zenoh.open(config)
        self._domain, self._name, self._types = os.environ["ROS_DOMAIN_ID"], name, Types(folders)
        self._held: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._last: dict[str, Any] = {}
        self._count = 0
        self._tokens: set[str] = set()
        space = f"@ros2_lv/{self._domain}/**"
        self._graph = self.session.liveliness().declare_subscriber(space, self._on_token, history=True)

    def _on_token(self, sample: Any) -> None:
        (self._tokens.add if sample.kind == zenoh.SampleKind.PUT else self._tokens.discard)(str(sample.key_expr))

    def _declare(self, kind: str, topic: str, name: str, latched: bool) -> tuple[str, bytes]:
        """Declare a token; return the data key and the gid."""
        package, group, own = name.split("/")
        key = f"{topic.strip('/')}/{package}::{group}::dds_::{own}_/{self._types.hash(name)}"
        self._count += 1
        head = f"@ros2_lv/{self._domain}/{self.session.info.zid()}/0/{self._count}/{kind}/%/%/{self._name}"
        durability = "1" if latched else ""
        token = f"{head}/{topic.replace('/', '%')}/{key.split('/', topic.count('/'))[-1]}/:{durability}:,100:,:,:,,"
        self._held.append(self.session.liveliness().declare_token(token))
        return f"{self._domain}/{key}", xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    def subscribe(self, command: dict[str, Any]) -> None:
        topic, name, latched = command["topic"], command["type"], command.get("latched", False)
        key, _ = self._declare("MS", topic, name, latched)

        def receive(sample: Any) -> None:
            data = sample.payload.to_bytes()
            sequence, stamp, size, _gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
            assert sequence > 0 and stamp > 0 and size == 16
            message = self._types.store.deserialize_cdr(data, name)
            say({"topic": topic, "message": self._types.plain(message, name)})

        if latched:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=100)
            subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                self.session, key, receive, history=history, subscriber_detection=True
            )
        else:
            subscriber = self.session.declare_subscriber(key, receive)
        self._held.append(subscriber)

    def advertise(self, command: dict[str, Any]) -> None:
        topic, latched = command["topic"], command.get("latched", False)
        key, gid = self._declare("MP", topic, command["type"], latched)
        watch = self.session.declare_publisher(key)
        publisher: Any = watch
        if latched:
            cache = zenoh.ext.CacheConfig(100)
            publisher = zenoh.ext.declare_advanced_publisher(self.session, key, cache=cache, publisher_detection=True)
        self._publishers[topic] = [publisher, command["type"], gid, 0, watch]

    def readers(self, command: dict[str, Any]) -> None:
        topic, deadline = command["topic"], time.monotonic() + TIMEOUT_S
        pattern = re.compile(rf"@ros2_lv/.*/MS/.*/{topic.replace('/', '%')}/.*")
        while True:
            count = sum(bool(pattern.fullmatch(token)) for token in self._tokens.copy())
            if count >= command["count"] and self._publishers[topic][4].matching_status.matching:
                return
            if time.monotonic() > deadline:
                raise TimeoutError(f"{topic}: {count} readers, expected {command['count']}")
            time.sleep(0.02)

    def publish(self, command: dict[str, Any]) -> None:
        topic = command["topic"]
        self._last[topic] = self._types.make(self._publishers[topic][1], command["fields"])
        self._put(topic)

    def again(self, command: dict[str, Any]) -> None:
        self._last[command["topic"]].header.stamp.sec = command["sec"]
        self._put(command["topic"])

    def _put(self, topic: str) -> None:
        publisher, name, gid, sequence, _ = self._publishers[topic]
        self._publishers[topic][3] = sequence + 1
        data = bytes(self._types.store.serialize_cdr(self._last[topic], name))
        publisher.put(data, attachment=struct.pack("<qqB16s", sequence + 1, time.time_ns(), 16, gid))

    def call(self, command: dict[str, Any]) -> None:
        topic, name = command["topic"], command["type"]
        self._types.service(name)
        key, gid = self._declare("SC", topic, name, False)
        request, response = (f"{name.replace('/srv/', '/msg/')}_{part}" for part in ("Request", "Response"))
        data = bytes(self._types.store.serialize_cdr(self._types.make(request, command["fields"]), request))

        def receive(reply: Any) -> None:
            if not reply.ok:
                say({"topic": topic, "message": {"error": reply.err.payload.to_string()}})
                return
            sequence, _stamp, _size, to = struct.unpack("<qqB16s", reply.ok.attachment.to_bytes())
            assert (sequence, to) == (77, gid)
            message = self._types.store.deserialize_cdr(reply.ok.payload.to_bytes(), response)
            say({"topic": topic, "message": self._types.plain(message, response)})

        self.session.get(
            key,
            receive,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=data,
            attachment=struct.pack("<qqB16s", 77, time.time_ns(), 16, gid),
            timeout=TIMEOUT_S,
        )


def main() -> None:
    client = Client(sys.argv[-1], sys.argv[1], sys.argv[2:-1])
    try:
        for line in sys.stdin:
            command = json.loads(line)
            try:
                getattr(client, command["do"])(command)
                say({"done": command["do"]})
            except Exception as error:  # reported to the test that gave the command
                say({"failed": f"{command['do']} {command['topic']}: {type(error).__name__}: {error}"})
    finally:
        client.session.close()


if __name__ == "__main__":
    main()
