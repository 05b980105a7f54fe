"""The profile as a file: what it may have, and where it is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.addons.deidentify.masks import Mask
from igtl_gateway.addons.deidentify.profile import BASIC, Profile, TextRule, read_profile
from igtl_gateway.base.errors import ConfigError
from tests.tables import table


def read(folder: Path, text: str) -> Profile:
    path = folder / "profile.toml"
    path.write_text(text, "utf-8")
    return read_profile(path)


def mask(folder: Path, row: str) -> Mask:
    profile = read(folder, f'[[mask]]\nstream = "IMAGE/*"\n{row}\n')
    found = profile.mask("IMAGE/a")
    assert found and profile.mask("VIDEO/a") is None
    return found


def test_an_empty_profile_is_the_basic_one(tmp_path: Path) -> None:
    assert read(tmp_path, "") == BASIC
    assert BASIC.text_rule("STRING/a").action == "remove" and BASIC.mask("IMAGE/a") is None


def test_all_that_a_profile_may_have(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        """
        [keep]
        names = ["Probe", "CT_*"]
        metadata = ["key"]
        types = ["MYTYPE"]
        [names]
        Anna = "first_1"
        Berta = "b"
        [[text]]
        stream = "STRING/log"
        action = "keep"
        [[text]]
        stream = "STRING/*"
        action = "pattern"
        pattern = "[0-9]+"
        by = "N"
        """,
    )
    assert (found.keep_names, found.keep_metadata, found.keep_types) == (("Probe", "CT_*"), ("key",), ("MYTYPE",))
    assert found.names == {"Anna": "first_1", "Berta": "b"}
    assert found.text_rules == (TextRule("STRING/log", "keep"), TextRule("STRING/*", "pattern", "N", "[0-9]+"))
    assert found.text_rule("STRING/log").action == "keep", "the first that matches"
    assert (found.text_rule("STRING/x").action, found.text_rule("STATUS/x").action) == ("pattern", "remove")


@table("value", [0, 1, 254, 255])
def test_a_mask_has_any_value_of_a_byte(value: int, tmp_path: Path) -> None:
    assert mask(tmp_path, f"rectangles = [[1, 2, 3, 4]]\nvalue = {value}").value == value


@table(
    ("row", "words"),
    [
        ("rectangles = [[1, 2, 3, 4]]\nvalue = 256", "mask[0].value: found 256, expected 0 to 255"),
        ("rectangles = [[1, 2, 3, 4]]\nvalue = -1", "mask[0].value: found -1, expected 0 to 255"),
        ("rectangles = [[1, 2, 3, 4]]\nvalue = true", "mask[0].value: found True, expected 0 to 255"),
        ("rectangles = [[1, 2, 3, 4]]\nvalue = 1.0", "mask[0].value: found 1.0, expected 0 to 255"),
        ("rectangles = 5", "mask[0].rectangles: found 5, expected [[x, y, width, height], …]"),
        ("rectangles = [[1, 2, 3]]", "mask[0].rectangles[0]: found [1, 2, 3], expected [x, y, width, height], whole"),
        (
            "rectangles = [[0, 0, 1, 1], [0, 0, -1, 1]]",
            "mask[0].rectangles[1]: found [0, 0, -1, 1], expected 0 or more",
        ),
        ("rectangles = [[0, 0, 1.5, 1]]", "mask[0].rectangles[0]: found [0, 0, 1.5, 1], expected [x, y, w"),
        ("rectangles = [[0, 0, 1, 1_000_001]]", "mask[0].rectangles[0]: found [0, 0, 1, 1000001]"),
        ("rectangles = []", "expected rectangles or a fan"),
        ("", "expected rectangles or a fan"),
        ("fan = [1, 2, 3]", "mask[0].fan: found [1, 2, 3], expected [x, y, near, far, from_deg, to_deg], numbers"),
        ("fan = [0, 0, 2, 2, 0, 90]", "expected 0 ≤ near < far and from_deg < to_deg ≤ from_deg + 360"),
        ("fan = [0, 0, -1, 2, 0, 90]", "expected 0 ≤ near < far"),
        ("fan = [0, 0, 1, 2, 90, 90]", "expected 0 ≤ near < far and from_deg < to_deg"),
        ("fan = [0, 0, 1, 2, 0, 361]", "≤ from_deg + 360"),
        ("fan = [0, 0, 1, nan, 0, 90]", "mask[0].fan: found [0, 0, 1, nan, 0, 90]"),
        ("rectangle = [1]", "mask[0].rectangle: unknown, expected one of stream, rectangles, fan, value"),
    ],
)
def test_a_mask_that_is_none(row: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        mask(tmp_path, row)
    assert str(caught.value).startswith(f"{tmp_path / 'profile.toml'}: ") and words in str(caught.value)


@table("row", ["fan = [0, 0, 0, 2, 0, 360]", "fan = [0.5, -3, 1, 2, -180, 180]", "rectangles = [[0, 0, 0, 1000000]]"])
def test_a_mask_at_its_limits(row: str, tmp_path: Path) -> None:
    assert mask(tmp_path, row).value == 0


@table(
    ("text", "words"),
    [
        ("[keeps]", "keeps: unknown, expected one of keep, names, text, mask"),
        ("keep = 5", "keep: found 5, expected a table [keep]"),
        ("[keep]\nname = []", "keep.name: unknown, expected one of"),
        ("[keep]\nnames = 5", "keep.names: found 5, expected a list of strings"),
        ("[keep]\nnames = [5]", "keep.names: found 5, expected a string"),
        ("names = 5", "names: found 5, expected a table [names]"),
        ('[names]\na = "1b"', "names.a: found '1b', expected a letter, then letters, digits and _, at most"),
        ("[names]\na = 5", "names.a: found 5, expected a letter"),
        ('[names]\na = "x"\nb = "x"', "names: found 'two equal new names', expected different ones"),
        ("text = 5", "text: found 5, expected tables [[text]]"),
        ("text = [5]", "text: found [5], expected tables [[text]]"),
        ("mask = [[1]]", "mask: found [[1]], expected tables [[mask]]"),
        ('[[text]]\nstream = "a"\naction = "hide"', "text[0].action: found 'hide', expected one of"),
        ('[[text]]\naction = "keep"', "text[0].stream: found '', expected a glob of streams"),
        ('[[text]]\nstream = "a"\naction = "keep"\npattern = "b"', "text[0].pattern: found 'b', expected a regular"),
        ('[[text]]\nstream = "a"\naction = "pattern"', "text[0].pattern: found '', expected a regular expression wi"),
        ('[[text]]\nstream = "a"\naction = "pattern"\npattern = "("', "text[0].pattern: found '(', expected a regu"),
        ('[[text]]\nstream = 5\naction = "keep"', "text[0].stream: found 5, expected a string"),
        ('[[mask]]\nrectangles = [[0, 0, 1, 1]]', "mask[0].stream: found '', expected a glob of streams, such as IMAG"),
    ],
)  # fmt: skip
def test_a_profile_that_is_none_names_its_place(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        read(tmp_path, text)
    assert words in str(caught.value), str(caught.value)
