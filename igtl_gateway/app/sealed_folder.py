"""What a reader takes from the folder of a split recording beside the sealed parts: their names, and ``metadata.yaml``.

The recorder writes the side file again after each part, so no seal has its bytes.  But all of it follows from the
parts: it is computed from them and compared.  So recordings that were sealed by older versions are checked likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from igtl_gateway.base.errors import GatewayError
from igtl_gateway.base.untrusted import files
from igtl_gateway.base.untrusted.yaml_text import parse_yaml
from igtl_gateway.record.retention.side_files import closed_part
from igtl_gateway.record.sessionfile.side_file import SIDE_FILE, side_file_text

_ROOT = "rosbag2_bagfile_information"
_TOPICS = "topics_with_message_count"
#: Facts about the writer, not about the parts.
_OF_THE_WRITER = ("version", "ros_distro")

#: What is known of the side file.
FOLLOWS = "follows from the sealed parts"
ABSENT = "is absent, as in a copy from an object store; the sealed parts are the whole recording"


def strange_file(folder: Path, parts: Sequence[Path]) -> str:
    """Return what is wrong with the names in a folder: a reader opens every .mcap file in it; "" if nothing is."""
    known = set(parts)
    strange = sorted(path.name for path in folder.glob("*.mcap") if path not in known)
    return f"{strange[0]}: found a file beside the parts of the recording" if strange else ""


def side_file_state(folder: Path, parts: Sequence[Path], *, cut: bool) -> tuple[str, str]:
    """Return what is known of ``metadata.yaml``, and what is wrong with it; "" if nothing is.

    Args:
        folder: the folder.
        parts: all its parts, in order.
        cut: whether the recording was cut off: then the last parts may be missing in the side file.
    """
    path = folder / SIDE_FILE
    if not path.exists() and not path.is_symlink():
        return "", ABSENT  # every closed recording has had one
    try:
        text = files.read_bytes(path).decode("utf-8")
        found = _facts(text, path)
        rows = [row for part in parts if (row := closed_part(part))]
        counts = [len(rows), len(rows) - 1] if cut else [len(rows)]
        texts = [side_file_text(rows[: max(count, 0)]) for count in counts]
        expected = [_facts(each, path) for each in texts]
    except (GatewayError, OSError, ValueError) as error:
        return "", f"cannot be read: {error}"
    if found in expected:
        is_written = any(_lines(text) == _lines(each) for each in texts)
        return (FOLLOWS, "") if is_written else ("", "its text differs from what the sealed parts state")
    wrong = next((key for key in (*expected[0], *found) if found.get(key) != expected[0].get(key)), _ROOT)
    return "", f"{wrong}: differs from what the sealed parts state"


def _lines(text: str) -> list[str]:
    """Return the lines in an order that does not depend on that of the topics, without those about the writer."""
    return sorted(line for line in text.split("\n") if line.strip().partition(":")[0] not in _OF_THE_WRITER)


def _facts(text: str, path: Path) -> dict[str, Any]:
    """Return the facts of a side file.  Raises GatewayError, ValueError."""
    document = parse_yaml(text, str(path))
    if not isinstance(document, dict) or list(document) != [_ROOT] or not isinstance(document[_ROOT], dict):
        raise ValueError(f"found other content, expected {_ROOT}")
    facts = {key: value for key, value in document[_ROOT].items() if key not in _OF_THE_WRITER}
    if isinstance(facts.get(_TOPICS), list):
        facts[_TOPICS] = sorted(facts[_TOPICS], key=repr)
    return facts
