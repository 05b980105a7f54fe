"""The message classes of the gateway, from the definitions of ROS.

    .venv/bin/python tools/messages.py             write them again
    .venv/bin/python tools/messages.py --check     are they current?

A definition is the ``.msg`` file of ``ros2/igtl_msgs`` or ``convert/interfaces``, or what rosbags has of ROS 2 Jazzy.
This file adds only what a definition does not have: which fields a caller may leave out, and the sentence about a
standard type.  The classes are files because mypy and people read them, and a start need not parse definitions.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from igtl_gateway.addon import ros
from igtl_gateway.convert.interfaces import SHARES, interface_files

ROOT = Path(__file__).resolve().parents[1]
LINE = 120


@dataclass(frozen=True)
class Row:
    """One class.

    Attributes:
        type: ROS type.
        meaning: text of the docstring after the type; empty = the first comment of the definition.
        optional: the first field that a caller may leave out, with all after it; empty = ``metadata``, or none.
        base: class of ``convert.by_hand`` with methods that are written by hand.
        name: of the class, if it is not that of the type.
        renamed: field of the definition → attribute.
    """

    type: str
    meaning: str = ""
    optional: str = ""
    base: str = ""
    name: str = ""
    renamed: dict[str, str] = field(default_factory=dict)

    @property
    def python(self) -> str:
        return self.name or self.type.rpartition("/")[2].replace("_", "")


#: Rows of our own types that have more than their definition.
OWN = (
    Row("igtl_msgs/msg/CommandReply", optional="error_message"),
    Row("igtl_msgs/msg/LabeledPoint", base="PointMethods"),
    Row("igtl_msgs/msg/PolyData", optional="vertices"),
    Row("igtl_msgs/msg/Query", optional="device_name"),
)
SERVICES = (
    Row("igtl_msgs/srv/Mark_Request", optional="text"),
    Row("igtl_msgs/srv/Mark_Response", "the answer.", "success"),
    Row("igtl_msgs/srv/SendCommand_Request"),
    Row("igtl_msgs/srv/SendCommand_Response", "the answer.", "status"),
)
#: Written by hand in sessionfile/layout.
NOT_HERE = ("igtl_msgs/msg/Note",)

COMMON = (
    Row("geometry_msgs/msg/PoseStamped", "metres."),
    Row("geometry_msgs/msg/PoseArray", "poses (n, 7) float64."),
    Row(
        "geometry_msgs/msg/TransformStamped",
        "inside a TFMessage; the transform is the pose of the child in the parent.",
        name="FrameTransform",
        renamed={"transform": "pose"},
        base="TransformMethods",
    ),
    Row("tf2_msgs/msg/TFMessage", "the type of /tf and /tf_static.", base="TfMethods"),
    Row("sensor_msgs/msg/JointState", "radians or metres, per second, newton metres or newtons.", "position"),
    Row("sensor_msgs/msg/RegionOfInterest", "pixels; all 0 = the whole image.", "x_offset"),
    Row(
        "sensor_msgs/msg/CameraInfo",
        "distortion d, intrinsics k (3 x 3), rectification r (3 x 3), projection p (3 x 4).",
        "binning_x",
    ),
    Row("sensor_msgs/msg/CompressedImage", "one picture, or one frame of a video."),
    Row("foxglove_msgs/msg/CompressedVideo"),
    Row("rcl_interfaces/msg/Log", "the log messages of nodes on /rosout.", "file"),
    Row("std_msgs/msg/MultiArrayDimension", "stride counts elements from this dimension inwards."),
    Row("std_msgs/msg/MultiArrayLayout", "outermost dimension first.", "dim"),
    Row("diagnostic_msgs/msg/DiagnosticArray", "the type of /diagnostics."),
    Row("geometry_msgs/msg/TwistStamped", "linear velocity x, y, z (m/s), then angular velocity x, y, z (rad/s)."),
    Row("geometry_msgs/msg/WrenchStamped", "force x, y, z (N), then torque x, y, z (N m)."),
    Row(
        "sensor_msgs/msg/Joy",
        "axes (n,) float32, buttons (m,) int32; of a pedal 1 pressed, 0 released, 2 clicked.",
        "axes",
    ),
    Row(
        "std_msgs/msg/Empty",
        "the byte is that of every ROS 2 message without a field.",
        "structure_needs_at_least_one_member",
    ),
    Row("crtk_msgs/msg/OperatingState", "DISABLED, ENABLED, PAUSED or FAULT.", "is_homed"),
    Row("crtk_msgs/msg/StringStamped", "the type of state_command (enable, disable, pause, resume, home, unhome)."),
)

VIEWED = (
    Row("nav_msgs/msg/Path", "poses one after the other."),
    Row("std_msgs/msg/Float64", "one number."),
)


@dataclass(frozen=True)
class Module:
    """One file of classes: its path in the source tree, its first line, its rows."""

    path: str
    title: str
    rows: tuple[Row, ...]

    @property
    def name(self) -> str:
        return self.path.removesuffix(".py").replace("/", ".")


def _own() -> tuple[Row, ...]:
    special = {row.type: row for row in OWN}
    names = [f"igtl_msgs/msg/{path.stem}" for path in interface_files("igtl_msgs") if path.suffix == ".msg"]
    return (*(special.get(name, Row(name)) for name in names if name not in NOT_HERE), *SERVICES)


MODULES = (
    Module("igtl_gateway/convert/igtl_msgs.py", "The messages of the package ``igtl_msgs`` as values.", _own()),
    Module(
        "igtl_gateway/convert/common_msgs.py",
        "Messages of common ROS packages as values; ``rosmsg`` has those that are written by hand for speed.",
        COMMON,
    ),
    Module(
        "igtl_gateway/addons/view/other_msgs.py",
        "Messages that the gateway does not convert but the viewer draws.",
        VIEWED,
    ),
)

#: ROS type (``[]``: a sequence of it) → Python type and name in ``convert.structs``.
VALUES = {
    "string": ("str", "STRING"),
    "bool": ("bool", "BOOL"),
    **{name: ("int", name.upper()) for name in ("int16", "uint8", "uint16", "uint32", "uint64")},
    "float64": ("float", "FLOAT64"),
    "uint8[]": ("Buffer", "OCTETS"),
    "builtin_interfaces/msg/Time": ("int", "TIME"),
    "std_msgs/msg/Header": ("Header", "HEADER"),
    "diagnostic_msgs/msg/DiagnosticStatus": ("DiagnosticStatus", "DIAGNOSTIC_STATUS"),
    "geometry_msgs/msg/Point": ("Point", "POINT"),
    "geometry_msgs/msg/Pose": ("Pose", "POSE"),
    "geometry_msgs/msg/Transform": ("Pose", "POSE"),
    "geometry_msgs/msg/Twist": ("SixNumbers", "TWIST"),
    "geometry_msgs/msg/Wrench": ("SixNumbers", "WRENCH"),
    "geometry_msgs/msg/Point[]": ("Array", "POINTS"),
    "geometry_msgs/msg/Pose[]": ("Array", "POSES"),
}
#: Numbers and length of an array of fixed length → its name; others are ``tuple[float, ...]``.
TUPLES = {("uint16", 3): "Size", ("uint8", 4): "Rgba", ("float64", 3): "Point"}
#: Python type → its value in a field that is left out.
ZEROS = {"str": '""', "int": "0", "float": "0.0", "bool": "False", "Buffer": 'b""'}

CLASSES = {row.type: (row, module) for module in MODULES for row in module.rows}
#: Where a name of the generated code comes from.
ORIGINS = {
    **dict.fromkeys(("Array", "Pose", "Point", "Rgba", "SixNumbers", "Size"), "igtl_gateway.convert.structs"),
    **dict.fromkeys(("fixed_array", "number_sequence", "sequence_of", "struct_of"), "igtl_gateway.convert.structs"),
    **dict.fromkeys((cdr for _, cdr in VALUES.values()), "igtl_gateway.convert.structs"),
    "Struct": "igtl_gateway.convert.structs",
    **dict.fromkeys(("Header", "DiagnosticStatus"), "igtl_gateway.convert.rosmsg"),
    **dict.fromkeys(("PointMethods", "TfMethods", "TransformMethods"), "igtl_gateway.convert.by_hand"),
    "Buffer": "igtl_gateway.base.buffers",
    **{row.python: module.name for row, module in CLASSES.values()},
}

_STORE = get_typestore(Stores.ROS2_JAZZY)


def text_of(name: str) -> str:
    """Return the ``.msg`` file of a type, or its part of a ``.srv`` file; empty for a type of ROS itself."""
    package, kind, stem = name.split("/")
    stem, _, part = stem.partition("_")
    files = (share / package / kind / f"{stem}.{kind}" for share in SHARES)
    text = next((path.read_text("utf-8") for path in files if path.is_file()), "")
    return text.split("---\n")[part == "Response"] if part else text


def definition(name: str) -> tuple[list[tuple[str, str, object]], list[tuple[str, tuple[Nodetype, object]]]]:
    """Return the constants (name, type, value) and the fields (name, description of rosbags) of a type."""
    text = text_of(name)
    parsed = name.replace("/srv/", "/msg/")  # rosbags knows no services
    found = get_types_from_msg(text, parsed)[parsed] if text else _STORE.fielddefs[name]
    return found  # type: ignore[return-value]


def _annotation(description: object) -> tuple[str, str]:
    """Return the Python type of a field and the expression of its CDR type."""
    match description:
        case (Nodetype.BASE, (str(name), _)) | (Nodetype.NAME, str(name)) if name in VALUES:
            return VALUES[name]
        case (Nodetype.NAME, str(name)):
            python = CLASSES[name][0].python
            return python, f"struct_of({python})"
        case (Nodetype.ARRAY, ((Nodetype.BASE, (str(name), _)), int(count))):
            return TUPLES.get((name, count), "tuple[float, ...]"), f'fixed_array("{name}", {count})'
        case (Nodetype.SEQUENCE, ((_, (str(name), _) | str(name)), _)) if f"{name}[]" in VALUES:
            return VALUES[f"{name}[]"]
        case (Nodetype.SEQUENCE, ((Nodetype.BASE, (str(name), _)), _)) if name != "string":
            return "Array", f'number_sequence("{name}")'
        case (Nodetype.SEQUENCE, (inner, _)):
            python, cdr = _annotation(inner)
            return f"tuple[{python}, ...]", f"sequence_of({python if cdr.startswith('struct_of') else cdr})"
    raise ValueError(f"found {description}, expected a type of this file's tables")


def _zero(python: str, cdr: str) -> str:
    if python == "Array":
        numbers = "float64" if "float64" in cdr or not cdr.startswith("number") else cdr.split('"')[1]
        return f"field(default_factory=lambda: np.empty(0, np.{numbers}))"
    return "()" if python.startswith("tuple") else ZEROS.get(python, f"{python}()")


def _comments(text: str) -> tuple[str, dict[str, str]]:
    """Return the first sentence of a definition, and the comment of each field."""
    first = re.match(r"# (.+)", text)
    fields = {name: comment for name, comment in re.findall(r"^[\w/\[\]]+\s+(\w+)\s*#\s*(.+)$", text, re.MULTILINE)}
    return (first[1] if first else ""), fields


def class_of(row: Row) -> Iterator[str]:
    """Yield the lines of one class."""
    constants, fields = definition(row.type)
    first, comments = _comments(text_of(row.type))
    optional = row.optional or "metadata"
    yield "@dataclass(frozen=True, slots=True)"
    yield f"class {row.python}({row.base or 'Struct'}):"
    sentence = f'    """{row.type}: {row.meaning or first}"""'
    yield sentence if len(sentence) <= LINE else f'    """{row.type}.\n\n    {row.meaning or first}\n    """'
    yield ""
    yield f'    TYPE: ClassVar[str] = "{row.type}"'
    for name, kind, value in constants:
        yield f"    {name}: ClassVar[{VALUES[kind][0]}] = {value!r}"
    may_be_left_out = False
    for name, description in fields:
        may_be_left_out |= name == optional
        python, cdr = _annotation(description)
        attribute = row.renamed.get(name, name) + ("_ns" if cdr == "TIME" else "")
        line = f"    {attribute}: Annotated[{python}, {cdr}]"
        if may_be_left_out:
            line += f" = {_zero(python, cdr)}"
        comment = f"  # {comments[name]}" if name in comments else ""
        if len(line + comment) > LINE:
            line, comment = f"   {comment}\n{line}", ""
        yield line + comment


def _ordered(rows: tuple[Row, ...]) -> list[Row]:
    """Return the rows, those that others use before these."""
    found: dict[str, Row] = {}

    def add(row: Row) -> None:
        for _, description in definition(row.type)[1]:
            for name in re.findall(r"\w+/msg/\w+", str(description)):
                used = CLASSES.get(name)
                if used is not None and used[0] in rows:
                    add(used[0])
        found.setdefault(row.type, row)

    for row in rows:
        add(row)
    return list(found.values())


def source(module: Module) -> str:
    """Return the whole file."""
    classes = "\n\n\n".join("\n".join(class_of(row)) for row in _ordered(module.rows))
    code = re.sub(r'""".*?"""|#[^\n]*', "", classes, flags=re.DOTALL)
    imports: dict[str, set[str]] = {}
    for word in set(re.findall(r"\b[A-Za-z_]\w+\b", code)) & ORIGINS.keys():
        if ORIGINS[word] != module.name:
            of_surface = module.path.startswith("igtl_gateway/addons/") and word in ros.__all__
            imports.setdefault(ros.__name__ if of_surface else ORIGINS[word], set()).add(word)
    lines = [
        f'"""{module.title}',
        "",
        "Generated by tools/messages.py from the definitions of ROS: change those, and run it again.  Lengths are in",
        "metres, stamps in UTC ns (0 = unset), poses are (x, y, z, qx, qy, qz, qw), number arrays numpy arrays.",
        '"""',
        "",
        "from __future__ import annotations",
        "",
        f"from dataclasses import dataclass{', field' if 'field(' in code else ''}",
        "from typing import Annotated, ClassVar",
        *(["", "import numpy as np"] if "np." in code else []),
        "",
        *(f"from {home} import {', '.join(sorted(names))}" for home, names in sorted(imports.items())),
        "",
        "",
        classes,
    ]
    ruff = Path(sys.executable).with_name("ruff")
    text = "\n".join(lines) + "\n"
    for arguments in (["check", "--quiet", "--select=I", "--fix"], ["format", "--quiet"]):
        command = [str(ruff), *arguments, "--stdin-filename", module.path, "-"]
        text = subprocess.run(command, cwd=ROOT, input=text, check=True, capture_output=True, text=True).stdout
    return text


def stale() -> list[str]:
    """Return the paths of the files that are not what the definitions give."""
    return [each.path for each in MODULES if (ROOT / each.path).read_text("utf-8") != source(each)]


def main() -> int:
    """Write the files, or report which are not current."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a file is not current")
    if parser.parse_args().check:
        for path in (found := stale()):
            print(f"{path} is not what its definitions give: run python tools/messages.py")
        return bool(found)
    for module in MODULES:
        (ROOT / module.path).write_text(source(module), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
