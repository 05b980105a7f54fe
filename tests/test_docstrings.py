"""``tools/docstrings.py``: docstrings and comments name what exists."""

from __future__ import annotations

from tests.tables import table
from tools.docstrings import all_faults

GOOD = '''
from parts import Gone

def receive(told_ns: int, *more: int) -> None:
    """Receive; see ``receive``, ``parts.Gone`` and a/parts.py.  Raises Gone or OSError.

    Args:
        told_ns: a time.
        more: others.

    Raises:
        ValueError: never.
    """


class Sender:  # ``receive`` is for others
    """Sends.

    Args:
        port: of the peer.
    """

    def __init__(self, port: int) -> None:
        self.port = port
'''
PARTS = 'class Gone(Exception):\n    """It is gone; see ``out.json``, which a program makes."""\n'
C = """/* As pass_on(), of _q.h; rows has the "/" of each. */
static int pass_on(int row_count) {  // row_count is not 0
    return put("/* not_a_comment */", '"', row_count);
}
"""
SOURCES = {"a/b.py": GOOD, "a/parts.py": PARTS, "a/_q.c": C, "a/_q.h": "int put(const char *, int, int);"}


def test_names_that_exist_are_no_fault() -> None:
    assert all_faults(SOURCES) == []


def test_a_parameter_and_a_name_that_do_not_exist_are_found() -> None:
    bad = GOOD.replace("(told_ns: int,", "(seen_ns: int,").replace("port: int", "address: int").replace("= port", "= 1")
    bad = bad.replace("see ``receive``", "see ``take``")
    assert all_faults(SOURCES | {"a/b.py": bad}) == [
        "a/b.py:5: the docstring names 'take', which does not exist",
        "a/b.py:5: the docstring of receive describes 'told_ns', which is not among its parameters",
        "a/b.py:17: the docstring of Sender describes 'port', which is not among its parameters",
    ]


@table(
    ("path", "old", "new", "fault"),
    [
        ("a/b.py", "Raises Gone or", "Raises _Gone or", "a/b.py:5: the docstring names '_Gone', which does not exist"),
        ("a/b.py", "parts.Gone", "parts.Sender", "a/b.py:5: the docstring names 'parts.Sender', which does not exist"),
        ("a/b.py", "a/parts.py", "b/parts.py", "a/b.py:5: the docstring names 'b/parts.py', which does not exist"),
        ("a/b.py", "# ``receive``", "# ``take``", "a/b.py:16: the comment names 'take', which does not exist"),
        ("a/_q.c", "As pass_on()", "As pass_in()", "a/_q.c:1: the comment names 'pass_in', which does not exist"),
        ("a/_q.c", "_q.h;", "_row.h;", "a/_q.c:1: the comment names the file '_row.h', which does not exist"),
        ("a/_q.c", "// row_count", "// row_size", "a/_q.c:2: the comment names 'row_size', which does not exist"),
    ],
)
def test_a_name_of_each_kind_that_does_not_exist_is_found(path: str, old: str, new: str, fault: str) -> None:
    assert old in SOURCES[path]
    assert all_faults(SOURCES | {path: SOURCES[path].replace(old, new)}) == [fault]


def test_other_files_and_names_of_the_repository_may_be_named() -> None:
    source = "# As ``RosType`` of docs/limits.md, by ``limit_of``.\n"
    assert len(all_faults({"a.py": source})) == 3
    assert all_faults({"a.py": source}, ["RosType", "limit_of"], ["docs/limits.md"]) == []
