"""The generated message classes against the definitions, by an independent serialiser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from igtl_gateway.addons.view import other_msgs
from igtl_gateway.base.errors import ConversionError
from igtl_gateway.convert import common_msgs, igtl_msgs
from igtl_gateway.convert.interfaces import definition_folder
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Struct
from igtl_gateway.record.sessionfile.layout import OWN_TYPES
from tests.places import ROOT, needs_sources
from tests.tables import table
from tools import messages

DEFINITIONS = ROOT / "ros2" / "igtl_msgs" / "msg"
CLASSES = {
    kind.TYPE: kind
    for module in (igtl_msgs, common_msgs, other_msgs)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Struct) and hasattr(kind, "TYPE")
}
#: Packed by hand in sessionfile/layout.
BY_HAND = {"igtl_msgs/msg/Note"}


def store() -> Typestore:
    known = get_typestore(Stores.ROS2_JAZZY)
    for package in ("igtl_msgs", "foxglove_msgs", "crtk_msgs"):
        for path in sorted(definition_folder(package).glob("msg/*.msg")):
            known.register(get_types_from_msg(path.read_text("utf-8"), f"{package}/msg/{path.stem}"))
    for row in messages.SERVICES:
        known.register(get_types_from_msg(messages.text_of(row.type), row.type.replace("/srv/", "/msg/")))
    return known


def theirs_of(kind: type[Struct], *, little_endian: bool = True) -> bytes:
    """A message of the type as rosbags, which knows no services, serialises it."""
    name = kind.TYPE.replace("/srv/", "/msg/")
    return bytes(STORE.serialize_cdr(sample(name), name, little_endian=little_endian))


STORE = store()


def test_every_definition_has_its_class() -> None:
    ours = {name for name in CLASSES if name.startswith("igtl_msgs/msg/")}
    assert {f"igtl_msgs/msg/{path.stem}" for path in DEFINITIONS.glob("*.msg")} == ours | BY_HAND


@needs_sources
def test_the_classes_are_what_the_definitions_give() -> None:
    assert messages.stale() == [], "python tools/messages.py"


def test_a_changed_definition_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    text = messages.text_of("igtl_msgs/msg/Capability")
    monkeypatch.setattr(messages, "text_of", lambda name: text.replace("types", "kinds") if "Cap" in name else "")
    row = next(row for row in messages.MODULES[0].rows if row.python == "Capability")
    assert "    kinds: Annotated[tuple[str, ...], sequence_of(STRING)]" in messages.class_of(row)


@pytest.mark.parametrize("name", OWN_TYPES)
def test_the_recording_has_the_same_definitions(name: str) -> None:
    assert OWN_TYPES[name] == (DEFINITIONS / f"{name.rpartition('/')[2]}.msg").read_text("utf-8")


def sample(name: str, depth: int = 0) -> Any:
    """A message of rosbags with something else in every field."""
    number = iter(range(1, 1000))

    def value(description: Any) -> Any:
        match description:
            case (1, ("string", _)) | (1, "string"):
                return f"text {next(number)} ü"
            case (1, (basic, _)) | (1, basic) if isinstance(basic, str):
                return True if basic == "bool" else float(next(number)) / 3 if "float" in basic else next(number)
            case (2, other):
                return sample(other, depth + 1)
            case (3, (inner, size)):
                return array(inner, size)
            case (4, (inner, _)):
                return array(inner, 3)
        raise AssertionError(description)

    def array(inner: Any, size: int) -> Any:
        values = [value(inner) for _ in range(size)]
        match inner:
            case (1, (basic, _)) if basic != "string":
                return np.array(values, basic)
        return values

    fields = {item: value(description) for item, description in STORE.fielddefs[name][1]}
    if name == "builtin_interfaces/msg/Time":
        fields = {"sec": 1_700_000_000 + next(number), "nanosec": 5}
    return STORE.types[name](**fields)


@table("kind", CLASSES.values(), ids=lambda kind: kind.__name__)
def test_read_and_written_byte_for_byte(kind: type[Struct]) -> None:
    theirs = theirs_of(kind)
    assert kind.unpack(theirs).pack() == theirs
    foreign = theirs_of(kind, little_endian=False)
    assert kind.unpack(foreign).pack() == theirs


@table("kind", CLASSES.values(), ids=lambda kind: kind.__name__)
def test_cut_off_is_refused(kind: type[Struct]) -> None:
    whole = theirs_of(kind)
    for size in range(len(whole) - 1):
        with pytest.raises(ConversionError):
            kind.unpack(whole[:size])


def test_a_number_beyond_its_field_is_refused() -> None:
    with pytest.raises(ConversionError, match="igtl_msgs/msg/Trajectory"):
        igtl_msgs.TrajectoryList(
            Header(), (igtl_msgs.Trajectory("", "", 1, (256, 0, 0, 0), (0, 0, 0), (0, 0, 0), 0.0, ""),)
        ).pack()
