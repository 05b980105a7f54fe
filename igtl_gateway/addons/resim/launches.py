"""Launch files of ROS 2 are no programs: each of their programs gets a connection of its own."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

from igtl_gateway.addon import ConfigError, DamagedRecording, GatewayError
from igtl_gateway.addon.untrusted import read_bytes

_ENDINGS = (".launch.py", ".launch.xml", ".launch.yaml", ".launch.yml", "_launch.py", "_launch.xml", "_launch.yaml")
#: What a launch file in Python has, whatever its name.
_FUNCTION = b"def generate_launch_description"
_NODES = ("Node", "LifecycleNode")
#: Programs that a line names.
_NAMED = 6


def refuse_launch_file(command: Sequence[str], title: str) -> None:
    """Raise ConfigError if a command starts a launch file; it names the programs in it, as far as they are known."""
    words = [Path(word).name for word in command]
    is_launch = words[:2] == ["ros2", "launch"]
    file = next((word for word in command if _is_launch_file(word, is_program=word in command[:2])), "")
    if not (is_launch or file):
        return
    found = f"found the launch file {Path(file).name}" if file else f"found {' '.join(command[:4])}"
    programs = list(dict.fromkeys(_programs(Path(file)))) if file else []
    behind = "".join(f" -- {each}" for each in programs[:_NAMED]) + (" …" if len(programs) > _NAMED else "")
    expected = "expected its programs, each behind a -- of its own, or a recipe (--recipe)"
    raise ConfigError(f"{title}: {found}, {expected}{behind and f'; in this file:{behind}'}")


def _is_launch_file(word: str, *, is_program: bool) -> bool:
    if word.endswith(_ENDINGS):
        return True
    path = Path(word)
    return is_program and path.suffix == ".py" and path.is_file() and _FUNCTION in _content(path)


def _content(path: Path) -> bytes:
    try:
        return read_bytes(path)
    except (GatewayError, OSError):
        return b""


def _programs(path: Path) -> Iterator[str]:
    """The programs of a launch file, as `ros2 run` starts them; none that the file computes."""
    content = _content(path)
    try:
        nodes = _in_xml(content) if path.suffix == ".xml" else _in_python(content) if path.suffix == ".py" else ()
        for package, executable in nodes:
            if package and executable:
                yield f"ros2 run {package} {executable}"
    except (SyntaxError, ValueError, RecursionError, DamagedRecording, ElementTree.ParseError):
        return


def _in_python(content: bytes) -> Iterator[tuple[str, str]]:
    for call in ast.walk(ast.parse(content)):
        if isinstance(call, ast.Call) and getattr(call.func, "id", getattr(call.func, "attr", "")) in _NODES:
            words = {each.arg: each.value.value for each in call.keywords if isinstance(each.value, ast.Constant)}
            yield str(words.get("package") or ""), str(words.get("executable") or "")


def _in_xml(content: bytes) -> Iterator[tuple[str, str]]:
    for node in ElementTree.fromstring(content).iter("node"):
        yield node.get("pkg", ""), node.get("exec", "")
