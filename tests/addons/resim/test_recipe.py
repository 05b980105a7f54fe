"""Programs from a TOML file; wrong ones are one line with file, place, value found and value expected."""

from __future__ import annotations

from pathlib import Path

import pytest

from igtl_gateway.addons.resim.engine import Program
from igtl_gateway.addons.resim.igtl_peer import IgtlRole
from igtl_gateway.addons.resim.recipe import read_recipe
from igtl_gateway.base.errors import ConfigError
from tests.tables import table

GOOD = """\
[[program]]
name = "planner"
command = ["python", "planner.py", "--level", "3"]
env = { SEED = "1" }
folder = "nodes"

[[program]]
command = "ros2 run 'my pkg' controller"

[[program]]
command = "viewer {port}"
igtl = "server"
port = 18944
link = 2
"""


def test_a_good_one(tmp_path: Path) -> None:
    (tmp_path / "nodes").mkdir()
    path = tmp_path / "programs.toml"
    path.write_text(f"permit_races = true\n{GOOD}", "utf-8")
    assert read_recipe(path).permits_races
    path.write_text(GOOD, "utf-8")
    assert not read_recipe(path).permits_races
    assert read_recipe(path).programs == [
        Program(("python", "planner.py", "--level", "3"), "planner", {"SEED": "1"}, tmp_path / "nodes"),
        Program(("ros2", "run", "my pkg", "controller")),
        Program(("viewer", "{port}"), igtl=IgtlRole(is_server=True, port=18944, link=2)),
    ]


@table(
    ("text", "line"),
    [
        ("", "found no program, expected [[program]] with a command"),
        ("[program]\ncommand = 'a'", "program: found another value, expected tables [[program]]"),
        ("permit_races = 1\n[[program]]\ncommand = 'a'", "permit_races: found 1, expected true or false"),
        ("[[programs]]\ncommand = 'a'", "programs: unknown table, expected [[program]]"),
        ("[[program]]", "program[0]: found no command, expected a string or a list of strings"),
        ("[[program]]\ncommand = ''", "program[0].command: found '', expected a string or a list of strings"),
        ("[[program]]\ncommand = []", "program[0].command: found [], expected a string or a list of strings"),
        ("[[program]]\ncommand = ['a', 1]", "program[0].command: found ['a', 1], expected"),
        ("[[program]]\ncommand = 3", "program[0].command: found 3, expected"),
        ('[[program]]\ncommand = "a \'b"', "expected words of a shell: No closing quotation"),
        ("[[program]]\ncommand = 'a'\nenvironment = {}", "program[0].environment: unknown key, expected one of name"),
        ("[[program]]\ncommand = 'a'\nenv = { A = 1 }", "program[0].env: found {'A': 1}, expected a table of strings"),
        ("[[program]]\ncommand = 'a'\nenv = { '' = '1' }", "program[0].env: found '', expected names of variables"),
        ("[[program]]\ncommand = 'a'\nenv = { 'A=' = '' }", "program[0].env: found 'A=', expected names of variables"),
        ("[[program]]\ncommand = 'a'\nfolder = 'none'", "program[0].folder: found no folder "),
        ("[[program]]\ncommand = 'a'\nname = ''", "program[0].name: found '', expected a string"),
        ("[[program]]\ncommand = 'a'\n[[program]]\ncommand = 'a'", "program: found 'a' twice, expected a name"),
        ("[[program]]\ncommand = 'a'\nigtl = 'peer'", "program[0].igtl: found 'peer', expected one of client, server"),
        ("[[program]]\ncommand = 'a'\nlink = 1", "program[0].link: has no effect without igtl"),
        ("[[program]]\ncommand = 'a'\nigtl = 'client'\nport = '1'", "program[0].port: found '1', expected a number"),
        ("[[program]]\ncommand = 'a'\nigtl = 'client'\nport = 70000", "port: found 70000, expected 0 to 65535"),
        ("[[program]\n", "programs.toml: "),
    ],
)  # fmt: skip
def test_wrong_ones(tmp_path: Path, text: str, line: str) -> None:
    path = tmp_path / "programs.toml"
    path.write_text(text, "utf-8")
    with pytest.raises(ConfigError) as error:
        read_recipe(path)
    assert str(error.value).startswith(f"{path}: ") and line in str(error.value)
    assert "\n" not in str(error.value)
