"""``tools/docstrings.py``: docstrings name what exists."""

from __future__ import annotations

from tools.docstrings import all_faults

GOOD = '''
def receive(told_ns: int, *more: int) -> None:
    """Receive; see ``receive``.

    Args:
        told_ns: a time.
        more: others.

    Raises:
        ValueError: never.
    """


class Sender:
    """Sends.

    Args:
        port: of the peer.
    """

    def __init__(self, port: int) -> None:
        self.port = port
'''


def test_names_that_exist_are_no_fault() -> None:
    assert all_faults({"a.py": GOOD}) == []


def test_a_parameter_and_a_name_that_do_not_exist_are_found() -> None:
    bad = GOOD.replace("(told_ns: int,", "(seen_ns: int,").replace("port: int", "address: int").replace("= port", "= 1")
    bad = bad.replace("``receive``", "``take``")
    assert all_faults({"a.py": bad}) == [
        "a.py:3: the docstring names 'take', which does not exist",
        "a.py:3: the docstring of receive describes 'told_ns', which is not among its parameters",
        "a.py:15: the docstring of Sender describes 'port', which is not among its parameters",
    ]
