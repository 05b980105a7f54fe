"""The states of ``native/passage/STATES.md``: equal to those of the code, and every order of steps keeps to them."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.native.states_model import (
    Kept,
    Memory,
    MemoryModel,
    Moves,
    NotInTable,
    Sub,
    SubscriptionModel,
    Tables,
    search,
    tables,
)
from tests.places import PACKAGE

HEADER = (PACKAGE / "native" / "passage" / "_states.h").read_text("utf-8")


def moves_in_c(name: str) -> Moves:
    """Return state → states after it, of a table in C; a state without any is left out."""
    body = re.search(rf"{name}\[\] = \{{(.*?)\}};", HEADER, re.DOTALL)
    assert body
    rows = re.findall(r"\[(\w+)\] = ([^,]*),", body[1])
    found = {before: frozenset(re.findall(r"TO\((\w+)\)", after)) for before, after in rows}
    return {before: after for before, after in found.items() if after}


def test_the_tables_of_the_document_are_those_of_the_code() -> None:
    document = tables()
    assert document.kept == moves_in_c("KEPT_MOVES")
    assert document.taker == moves_in_c("TAKER_MOVES")
    assert document.holds == moves_in_c("HOLDS_MOVES")
    assert min(len(Tables.rows(one)) for one in (document.kept, document.taker, document.holds)) >= 4


@pytest.mark.parametrize("failures", [0, 2])
def test_every_order_of_steps_of_a_subscription(failures: int) -> None:
    """No message is lost, passes twice or out of order, and only one thread takes at a time."""
    found = tables()
    model = SubscriptionModel(found, failures)
    states = search(Sub(coming=4), model.steps, model.check)
    assert states > 500
    if failures:
        assert found.used == Tables.rows(found.taker, found.holds), "a row of STATES.md that no thread uses"


@pytest.mark.parametrize("failures", [0, 1])
def test_the_search_finds_a_message_that_is_left_behind(failures: int) -> None:
    model = SubscriptionModel(tables(), failures, forgets=True)
    with pytest.raises(AssertionError, match="left behind"):
        search(Sub(coming=3), model.steps, model.check)


def test_every_order_of_steps_of_the_memory_of_messages() -> None:
    """It is freed once, when its last owner leaves, and the recorder copies nothing that is gone."""
    found = tables()
    for to_ros in (True, False):
        model = MemoryModel(found, to_ros=to_ros)
        assert search(model.begin(3), model.steps, model.check) > 300
    assert found.used == Tables.rows(found.kept), "a row of STATES.md that no thread uses"


def test_the_search_finds_memory_that_is_freed_too_early() -> None:
    model = MemoryModel(tables(), to_ros=True, forgets=True)
    with pytest.raises(AssertionError):
        search(model.begin(2), model.steps, model.check)


def test_another_transition_is_refused() -> None:
    model = MemoryModel(tables(), to_ros=True)
    filled = Memory((Kept("GONE", 1, stream=True, step=9),), (False,))
    with pytest.raises(NotInTable, match="GONE to TAKEN"):
        list(model.steps(filled))


def test_a_checked_build_aborts_at_another_transition(tmp_path: Path) -> None:
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")[0]
    source, target = tmp_path / "move.c", tmp_path / "move"
    source.write_text(
        '#include "_states.h"\n'
        "int main(int count, char **words)\n"
        '{ return (void)words, moved("it", KEPT_MOVES, count > 1 ? GONE : OWN, STAYS) != STAYS; }\n'
    )
    words = [compiler, "-DIGTL_GATEWAY_CHECKED", f"-I{PACKAGE / 'native' / 'passage'}", "-o", str(target), str(source)]
    try:
        subprocess.run(words, check=True)
    except OSError:
        pytest.skip("no C compiler")
    assert subprocess.run([target], check=False).returncode == 0
    run = subprocess.run([target, "wrong"], capture_output=True, text=True, check=False)
    assert (run.returncode, "not in STATES.md" in run.stderr) == (-signal.SIGABRT, True)
