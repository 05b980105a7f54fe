"""Verbs of other distributions: found, refused, and absent."""

from __future__ import annotations

from importlib import metadata

import pytest

from igtl_gateway.cli import main, verbs


class _Entry:
    def __init__(self, name: str, value: object) -> None:
        self.name, self.value, self._value = name, f"other.package:{name.upper()}", value

    def load(self) -> object:
        if isinstance(self._value, Exception):
            raise self._value
        return self._value


def install(monkeypatch: pytest.MonkeyPatch, **values: object) -> None:
    """The entry points of this machine become these."""
    monkeypatch.setattr(metadata, "entry_points", lambda group: [_Entry(*item) for item in values.items()])


def test_the_laboratory_adds_its_verbs() -> None:
    assert set(verbs.LABORATORY) <= verbs.available().keys()
    assert not set(verbs.LABORATORY) & verbs.VERBS.keys()


def test_without_the_laboratory_its_verbs_say_where_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(monkeypatch)
    assert main(["simulate", "star"]) == 2
    assert "igtl-gateway-lab" in capsys.readouterr().err


def test_nothing_replaces_a_verb_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, info=verbs.Verb("another info", "another.module"), later=verbs.Verb("more", "more.module"))
    assert verbs.available()["info"] is verbs.VERBS["info"]
    assert [*verbs.groups(verbs.available())["Other"]] == ["later"]
    assert list(verbs.available())[-1] == "later"


@pytest.mark.parametrize("value", [ImportError("no module named other"), 3], ids=["raises", "no verb"])
def test_a_broken_verb_leaves_the_others_alone(
    value: object, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(monkeypatch, broken=value)
    assert main(["broken"]) == 1
    assert "other.package:BROKEN" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        main(["info", "--help"])
    assert end.value.code == 0
