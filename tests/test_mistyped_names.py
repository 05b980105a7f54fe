"""A name with a mistake is never silent with exit code 0: each option of each verb that names something recorded.

Strategy: one table of commands; each has one wrong name.  The command fails, or its output has the wrong name; where a
near name exists, the output has it.  The parsers have all options, so an option that is new needs a row.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import igtl_gateway
from igtl_gateway import cli
from igtl_gateway.base.errors import ConfigError, GatewayError
from igtl_gateway.config.configuration import Config
from igtl_gateway.config.triggers import trigger
from igtl_gateway.convert.common_msgs import JointState, WrenchStamped
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.gateway.expected import PresentSources, expected_sources, missing_sources
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Note
from igtl_gateway.record.sessionfile.schemas import RosTypes
from igtl_gateway.record.triggers import Triggers
from igtl_gateway.testing.compare import assert_session_equal
from igtl_gateway.testing.gateway import ManualGateway
from igtl_gateway.testing.peer import ReplayPeer
from tests.places import FIXTURES
from tests.tables import table

ACQUISITION, STAR = FIXTURES / "acquisition.mcap", FIXTURES / "star.mcap"


class Row(NamedTuple):
    """A command with a wrong name; ``FILE`` is a recording, ``OUT`` a folder.

    Attributes:
        words: the command.
        wrong: the wrong name, as the output has it.
        near: a near name that the output has.
        code: 1: any exit code but 0; 0: that one, with a line.
    """

    words: str
    wrong: str
    near: str = ""
    code: int = 1
    file: Path = ACQUISITION


ROWS = [
    Row("replay FILE --to igtl --streams STRING/Robt", "STRING/Robt", "STRING/Robot"),
    Row("replay FILE --to igtl --through-gateway --send /igtl/out/Robt=Arm", "/igtl/out/Robt=Arm"),
    Row("replay FILE --to igtl --start mark:nope", "mark:nope"),
    Row("replay FILE --to igtl --end mark:nope", "mark:nope"),
    Row("diff FILE FILE --streams STRING/Robt", "STRING/Robt", "STRING/Robot"),
    Row("diff FILE FILE --streams STRING/Robt --streams **", "STRING/Robt", "STRING/Robot"),
    Row("slice FILE -o OUT/a.mcap --streams STRING/Robt", "STRING/Robt", "STRING/Robot"),
    Row("slice FILE -o OUT/b.mcap --streams STRING/Robt --streams **", "STRING/Robt", "STRING/Robot", 0),
    Row("slice FILE -o OUT/c.mcap --start mark:nope", "mark:nope"),
    Row("slice FILE -o OUT/d.mcap --end mark:nope", "mark:nope"),
    Row("slice FILE -o OUT/e.mcap --config CONFIG", "Planer", "Planner", 0),
    Row("verify FILE --config CONFIG", "/igtl/out/Robot/strng", "/igtl/out/Robot/string"),
    Row("export FILE --to csv -o OUT/f --streams STRING/Robt", "STRING/Robt", "STRING/Robot"),
    Row("export FILE --to csv -o OUT/g --streams STRING/Robt --streams STRING/*", "STRING/Robt", "STRING/Robot", 0),
    Row("export FILE --to csv -o OUT/h --streams in:STRING/Robot --streams STRING/*", "in:STRING/Robot", "", 0),
    Row("export FILE --to csv -o OUT/i --streams STRING/Robot@9 --streams STRING/*", "STRING/Robot@9", "", 0),
    Row("sync FILE STRING/Robt IMAGE/Probe", "STRING/Robt", "STRING/Robot"),
    Row("sync FILE TRANSFORM/ProbeToBase IMAGE/Probe --pair IMAGE/Prob STRING/Robot", "IMAGE/Prob", "IMAGE/Probe"),
    Row("merge a=FILE b=STAR -o OUT/j.mcap --sync STRING/Robt /star/tool", "STRING/Robt", "STRING/Robot"),
    Row("merge a=FILE b=STAR -o OUT/k.mcap --offset c=1", "'c'"),
    Row("merge FILE --extract nope -o OUT/l.mcap", "nope"),
    Row("mark FILE --remove nope", "nope"),
    Row("mark FILE --label x --at mark:nope", "mark:nope"),
    Row("mark FILE --label x --at 1 --until mark:nope", "mark:nope"),
    Row("view FILE -o OUT/m.rrd --sync STRING/Robt IMAGE/Probe", "STRING/Robt", "STRING/Robot"),
    Row("view FILE -o OUT/n.rrd --blueprint genric", "genric", "generic"),
    Row("view FILE -o OUT/o.rrd --colour-by intensty", "intensty", "", 0),
    Row("view FILE -o OUT/p.png --at mark:nope", "mark:nope"),
    Row("view FILE -o OUT/q.rrd --urdf /PSM9=URDF", "/PSM9", "", 0),
    Row("review FILE --plan /star/plna", "/star/plna", "/star/plan", file=STAR),
    Row("review FILE --cloud /star/cluod", "/star/cluod", "/star/cloud", file=STAR),
    Row("review FILE --tool suture_tol", "suture_tol", "suture_tool", file=STAR),
    Row("cohort review FILE -o OUT/r --plan /star/plna --workers 1", "/star/plna", "/star/plan", file=STAR),
    Row("cohort review FILE -o OUT/s --cloud /star/cluod --workers 1", "/star/cluod", "/star/cloud", file=STAR),
    Row("cohort review FILE -o OUT/t --tool suture_tol --workers 1", "suture_tol", "suture_tool", file=STAR),
    Row("cohort sync FILE -o OUT/u --stream STRING/Robt --stream IMAGE/Probe --workers 1", "STRING/Robt"),
    Row(
        "cohort sync FILE -o OUT/v --stream TRANSFORM/ProbeToBase --stream IMAGE/Probe --pair a b --workers 1",
        "'a'",
    ),
    Row("resim FILE --start mark:nope -- true", "mark:nope"),
    Row("resim FILE --end mark:nope -- true", "mark:nope"),
    Row("resim FILE --input /igtl/out/Robt/string --runs 1 -- true", "/igtl/out/Robt/string", "Robot/string"),
    Row("deidentify FILE -o OUT/w.mcap --profile PROFILE", "mask[0]", "/igtl/out/Probe/image"),
    Row("sync FILE /star/tool /star/camera_pose --frame suture_tol", "suture_tol", "", file=STAR),
]

#: Metavars that are names.
NAMES = {
    "DEVICE", "DEVICE=KIND[,KIND…]", "FIELD", "FRAME[,FRAME…]:BASE[=DEVICE[:TYPE]]", "GLOB", "GLOB=CLASS", "LABEL[#N]",
    "NAME", "NAME=S", "STREAM", "TIME", "TOPIC", "TOPIC[=DEVICE[:TYPE]]", "TYPE", "TYPE=MIB", "[NAMESPACE=]FILE",
    "HOST:PORT=PROFILE", "RULE",
}  # fmt: skip
#: Options that are tested elsewhere, or name nothing that exists before.
ELSEWHERE = {
    # of a live bridge: below; by tests/cli/test_bridge_output.py (types), tests/config (profiles, kinds, classes)
    *(f"bridge --{name}" for name in (
        "allow-in allow-out mark-from kinds tf-out record-topics record-include record-exclude send deny-in deny-out "
        "max-body site-class peer trigger site node-name retention"
    ).split()),
    # with real programs: tests/addons/resim/test_quiet.py
    "resim --output", "resim --without",
    # with a data set: tests/addons/lerobot/test_tracing.py
    "export --feature",
    # a new name, a rule of ages, a date
    "mark --who", "keep --retention", "retain --retention", "upload --retention", "import --epoch",
    # closed lists that argparse checks
    "bench --case", "bench --sweep",
}  # fmt: skip


@pytest.fixture(name="place")
def _place(tmp_path: Path) -> Path:
    (tmp_path / "CONFIG").write_text(
        '[[to_igtl]]\ntopic = "/igtl/out/Robot/strng"\ndevice = "Robot"\n[[to_ros]]\ndevice = "Planer"\n', "utf-8"
    )
    mask = '[[mask]]\nstream = "/igtl/out/Prob/image"\nrectangles = [[0, 0, 1, 1]]\n'
    (tmp_path / "RULES").write_text(f'[keep]\nnames = ["Robt"]\n{mask}', "utf-8")
    (tmp_path / "URDF").write_text('<robot name="a"><link name="b"/></robot>', "utf-8")
    return tmp_path


def commanded(row: Row, place: Path) -> list[str]:
    words = {"CONFIG": "OUT/CONFIG", "PROFILE": "OUT/RULES"}
    return [
        words.get(word, word)
        .replace("FILE", str(row.file))
        .replace("OUT/", f"{place}/")
        .replace("URDF", str(place / "URDF"))
        .replace("STAR", str(STAR))
        for word in row.words.split()
    ]


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.words)
def test_a_wrong_name_fails_or_is_reported(row: Row, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(commanded(row, place))
    printed = "".join(capsys.readouterr())
    assert row.wrong in printed and row.near in printed, printed
    assert bool(code) == bool(row.code), printed


def test_each_option_that_is_a_name_has_a_row() -> None:
    _, parsers = cli.parser_of_all_verbs()
    options = {
        f"{parser.prog.split()[1]} {action.option_strings[-1]}"
        for parser in parsers
        for action in parser._actions
        if action.option_strings and {action.metavar} & NAMES
    }
    rows = {f"{row.words.split()[0]} {word}" for row in ROWS for word in row.words.split() if word[:2] == "--"}
    assert options - rows - ELSEWHERE == set()


def test_what_a_bridge_names_and_does_not_get() -> None:
    config = Config.from_dict(
        {
            "to_igtl": [{"topic": "/tol"}],
            "to_ros": [{"device": "Prob"}],
            "tf_out": [{"frames": ["tol0"], "base": "base"}],
            "crtk": [{"arms": "/PSM"}],
            "mark_from": ["Planer"],
            "allow_in": ["PSM1/servo_cpp"],
            "allow_out": ["PSM1/move_pc"],
        }
    )
    present = PresentSources(
        ("/tool", "/PSM1/measured_cp", "/PSM1/move_cp"),
        ("tool0", "base"),
        ("Probe", "Planner", "PSM1/servo_cp"),
        ("/tool", "IMAGE/Slice", "Slice"),
    )
    expected = expected_sources(config, ["/cluod"], ["IMAGE/Slce", "/camra/**", "Slice"], ["/tol", "/other"])
    found = {each.source.setting: each.text for each in missing_sources(expected, present)}
    assert found.pop("--record-topics") == "topic /cluod: no publisher (--record-topics)"
    assert "stream /camra/**: no stream has this name (--record-include)" in [
        each.text for each in missing_sources(expected, present)
    ]
    near = {
        "to_igtl[0]": "/tool", "to_ros[0]": "Probe", "tf_out[0]": "tool0", "crtk[0]": "/PSM1", "mark_from": "Planner",
        "allow_in": "PSM1/servo_cp", "allow_out": "/PSM1/move_cp", "--record-exclude": "/tool",
    }  # fmt: skip
    found.pop("--record-include")
    assert {setting: text.partition("did you mean '")[2].partition("'")[0] for setting, text in found.items()} == near
    nothing = PresentSources((), (), ("x",), ("x",))
    optional = {"mark_from", "allow_in", "allow_out", "--record-exclude"}
    assert not optional & {each.source.setting for each in missing_sources(expected, nothing)}


def test_what_a_trigger_or_a_class_names_and_does_not_get() -> None:
    rules = [
        trigger(each)
        for each in ("value=/forse,field=z,above=1", "status=Prob", "loss=IMAGE/Slce", "guard=IMAGE/Absent", "mark")
    ]
    kinds = Config.from_dict({"to_ros": [{"device": "Planer", "kinds": ["string"]}]})
    expected = expected_sources(kinds, triggers=rules, classed=["/igtl/in/Slce/**"])
    names = ("/force", "/igtl/in/Slice/image", "IMAGE/Slice", "Slice")
    missing = missing_sources(expected, PresentSources(("/force",), (), ("Probe", "Planner"), names))
    assert {each.source.setting: each.text for each in missing if each.source.setting != "--trigger"} == {
        "to_ros[0]": "device Planer: no peer sends it; did you mean 'Planner'? (to_ros[0])",
        "--site-class": "stream /igtl/in/Slce/**: no stream has this name; did you mean '/igtl/in/Slice/image'? "
        "(--site-class)",
    }
    assert [each.text for each in missing if each.source.setting == "--trigger"] == [
        "topic /forse: no publisher; did you mean '/force'? (--trigger)",
        "device Prob: no peer sends it; did you mean 'Probe'? (--trigger)",
        "stream IMAGE/Slce: no stream has this name; did you mean 'IMAGE/Slice'? (--trigger)",
    ]
    everything = PresentSources(("/forse",), (), ("Prob", "Planer"), ("/igtl/in/Slce/image", "IMAGE/Slce"))
    assert missing_sources(expected, everything) == []


@table(
    ("rule", "near"),
    [("note=bad_crd", "bad_crc"), ("note=queue_dorp", "queue_drop"), ("note=zenoh_*_nope", ""), ("note=nope/**", "")],
)
def test_a_trigger_by_an_unknown_code_is_refused(rule: str, near: str) -> None:
    with pytest.raises(ConfigError) as caught:
        trigger(rule)
    assert rule.partition("=")[2] in str(caught.value) and near in str(caught.value)


@table(
    ("field", "why"),
    [
        ("wrench.forc.z", "found no 'forc'; did you mean 'force'?"),
        ("wrench.force.w", "found no 'w'"),
        ("rench", "found no 'rench'; did you mean 'wrench'?"),
        ("wrench.force[1]", "'force' is not an array"),
        ("wrench.force", "it is not a number"),
        ("header.frame_id", "it is not a number"),
        ("wrench.force.z", ""),
    ],
)
def test_a_field_of_a_trigger_that_no_message_has_is_reported_once(field: str, why: str) -> None:
    notes: list[Note] = []
    triggers = Triggers([trigger(f"value=/f*,field={field},above=5")], RosTypes(), on_note=notes.append)
    data = WrenchStamped(Header(), (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)).pack()
    for number in range(3):
        triggers.look(Entry(number, number, Kind.ROS_IN, "/force", WrenchStamped.TYPE, (data,)))
    assert [(note.code, note.stream) for note in notes] == [("no_source", "/force")] * bool(why)
    assert all(why in note.text and field in note.text for note in notes)


@table(("values", "why"), [((), ""), ((1.0,), "'position' has 1 value"), ((1.0, 2.0, 3.0), "")])
def test_an_index_of_a_trigger_beyond_the_values_is_reported(values: tuple[float, ...], why: str) -> None:
    notes: list[Note] = []
    triggers = Triggers([trigger("value=/j,field=position[2],above=5")], RosTypes(), on_note=notes.append)
    data = JointState(Header(), (), np.array(values)).pack()
    triggers.look(Entry(1, 1, Kind.ROS_IN, "/j", JointState.TYPE, (data,)))
    assert [note.text.rpartition(": ")[2] for note in notes] == ([why] if why else [])


def opened() -> Any:
    return igtl_gateway.open(ACQUISITION)


CASES: dict[str, Callable[[], object]] = {
    "recording": lambda: opened()["STRING/Robt"],
    "diff": lambda: igtl_gateway.diff(ACQUISITION, ACQUISITION, streams="STRING/Robt"),
    "diff, one of two": lambda: igtl_gateway.diff(ACQUISITION, ACQUISITION, streams=["STRING/Robt", "**"]),
    "replay": lambda: igtl_gateway.replay_recording(ACQUISITION, streams=["STRING/Robt"], listen=[("127.0.0.1", 0)]),
    "peer": lambda: ReplayPeer(ACQUISITION, streams=["STRING/Robt"]),
    "peer, one of two": lambda: ReplayPeer(ACQUISITION, streams=["STRING/Robt", "STRING/*"]),
    "play": lambda: ManualGateway(ACQUISITION).play(ACQUISITION, ["STRING/Planer"]),
    "play, one of two": lambda: ManualGateway(ACQUISITION).play(ACQUISITION, ["STRING/Planer", "STRING/*"]),
    "align": lambda: igtl_gateway.align([opened()["TRANSFORM/ProbeToBase"]], on="TRANSFORM/ProbToBase"),
    "lookup": lambda: opened().tf.lookup("base", "nope", opened()["TRANSFORM/ProbeToBase"]),
    "ignored": lambda: warned(ACQUISITION, ignore=["STRING/Robt"]),
}  # fmt: skip


def warned(path: Path, **settings: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_session_equal(path, path, **settings)


@table("name", list(CASES))
def test_a_wrong_name_in_python(name: str) -> None:
    with pytest.raises((ConfigError, GatewayError, KeyError, UserWarning)) as caught:
        CASES[name]()
    text = str(caught.value)
    assert "Robt" in text or "Planer" in text or "ProbToBase" in text or "nope" in text, text
