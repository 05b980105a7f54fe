"""Names: legal ROS tokens, stable shortening, the AToB convention."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.convert.names import MAX_TOKEN, frames_of, name_hash, short_device_name, topic_token
from tests.tables import table


@pytest.mark.parametrize(
    ("name", "token"),
    [
        ("Probe", "Probe"),
        ("", "unnamed"),
        ("3D", "_3D"),
        ("a b/c.d", "a_b_c_d"),
        ("Café", "Caf_"),
        ("a" * MAX_TOKEN, "a" * MAX_TOKEN),
    ],
)
def test_topic_token(name: str, token: str) -> None:
    assert topic_token(name) == token


@given(st.text(max_size=300))
def test_tokens_are_legal(name: str) -> None:
    assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", topic_token(name))
    assert len(topic_token(name)) <= MAX_TOKEN + 1


def test_names_without_limit_stay_apart() -> None:
    one, two = topic_token("a" * 5000 + "x"), topic_token("a" * 5000 + "y")
    assert one != two
    assert len(one) == MAX_TOKEN


@table(
    ("name", "frames"),
    [
        ("ProbeToTracker", ("Tracker", "Probe")),
        ("Probe", ("base", "Probe")),
        ("", ("base", "unnamed")),
        ("Tomato", ("base", "Tomato")),
        ("ToTracker", ("base", "ToTracker")),
        ("ProbeTo", ("base", "ProbeTo")),
        ("ProbeTotal", ("base", "ProbeTotal")),
        ("AToBToC", ("BToC", "A")),
    ],
)
def test_frames(name: str, frames: tuple[str, str]) -> None:
    assert frames_of(name, "base") == frames_of(name, "base", naming=1) == frames


@table(("name", "frames"), [("ProbeTo3D", ("3D", "Probe"))])
def test_frames_as_plus_divides_names(name: str, frames: tuple[str, str]) -> None:
    assert frames_of(name, "base") == frames and frames_of(name, "base", naming=1) == ("base", name)


@given(st.text(max_size=60))
def test_short_names_fit(name: str) -> None:
    short = short_device_name(name)
    assert len(short.encode()) <= 20
    assert (short == name) is (len(name.encode()) <= 20)


def test_shortening_is_stable() -> None:
    """The hash is CRC-32 of the name: the same in every release, on every machine."""
    assert name_hash("123456789") == "3926"  # CRC-32 check value cbf43926
    assert short_device_name("StylusTipToReferenceSensor").startswith("StylusTipToRefe_")
    assert short_device_name("\udcff" * 21)[-5] == "_"
