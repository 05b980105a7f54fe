"""A name that is not there is answered with the nearest one, in every verb that takes one.

Strategy: one table of commands, with a name that is one letter off, and the name that is meant.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from igtl_gateway.cli import main
from tests.marked import write
from tests.places import FIXTURES

#: Command → what was meant; ``S`` is the recording of the scenario star, ``M`` one with marks.
COMMANDS = {
    "info stra.mcap": "star.mcap",
    "verify stra.mcap": "star.mcap",
    "diff S stra.mcap": "star.mcap",
    "export stra.mcap --to csv -o o": "star.mcap",
    "import stra.mcap -o o": "star.mcap",
    "view stra.mcap -o o.rrd": "star.mcap",
    "recover stra.mcap -o o": "star.mcap",
    "replay stra.mcap --to igtl": "star.mcap",
    "decode stra.mcap": "star.mcap",
    "doctor stra.mcap": "star.mcap",
    "info fodler/a.mcap": "folder",
    "page fodler": "folder",
    "keep fodler --retention 1d": "folder",
    "slice S -o o.mcap --streams TolToBase": "TRANSFORM/ToolToBase",
    "diff S S --streams /star/tol": "/star/tool",
    "export S --to csv -o o --streams /star/tol": "/star/tool",
    "replay S --to ros --streams /star/tol": "/star/tool",
    "sync S TRANSFORM/TolToBase /star/tool": "TRANSFORM/ToolToBase",
    "view S -o o.rrd --plot /star/tol.x": "/star/tool",
    "view S -o o.rrd --plot TRANSFORM/ToolToBase.x_mn": "x_mm",
    "view S -o o.rrd --sync /star/tol /star/tool": "/star/tool",
    "view S -o o.rrd --blueprint genric": "generic",
    "review S --plan /star/pln": "/star/plan",
    "slice M -o o.mcap --start mark:sutur-1": "suture-1",
    "mark M --remove sutur-1": "",
    "export S --to NRRD -o o": "nrrd",
    "info S --limit memry=5": "memory",
    "merge a=S b=M -o o.mcap --offset c=1": "",
    "bridge --profile slicr": "slicer",
    "bridge --peer localhost:1=plsu": "plus",
    "bridge --kinds A=imge": "image",
    "bridge --compression ztsd": "zstd",
    "bridge --relay --connect localhost:1 --fault dely=1ms": "delay",
    "bridge --snapshot 5 --record o.mcap --trigger note=bad_crd": "bad_crc",
    "replay S --to iglt": "igtl",
    "completion bahs": "bash",
    "cohort inof S -o o": "info",
    "simulate acquisiton": "acquisition",
    "bench --case transfrm": "transform",
    "seal keys sho S": "",
}


@pytest.mark.slow
def test_a_wrong_name_is_answered_with_the_nearest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    shutil.copy(FIXTURES / "star.mcap", "star.mcap")
    write(Path("marked.mcap"))
    wrong = {}
    for command, meant in COMMANDS.items():
        words = [
            "=".join({"S": "star.mcap", "M": "marked.mcap"}.get(part, part) for part in word.split("="))
            for word in command.split()
        ]
        try:
            code = main(words)
        except SystemExit as exit:
            code = int(exit.code or 0)
        printed = "".join(capsys.readouterr())
        if code not in (1, 2) or (meant and f"did you mean '{meant}'" not in printed):
            wrong[command] = printed
    assert not wrong
