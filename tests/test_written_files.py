"""One way to write a file for all verbs: whole or not at all, and never less than before."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from igtl_gateway.cli import USAGE, main
from tests.cli.writers import SMALL, WRITERS, sound_files
from tests.places import FIXTURES
from tests.test_private_files import TREES

resource = pytest.importorskip("resource", reason="needs the limits of POSIX")

#: Of the table of writers: those whose output the user names.  Keys are never replaced.
_COMMANDS = [words for words in WRITERS if "OUT" in words and not words.startswith("keys")]
_OLD = b"the work of a day"
#: Bytes that a file may have while the disk is full.
_ROOM = 64


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return sound_files(tmp_path_factory.mktemp("sound"))


@contextmanager
def _full_disk() -> Iterator[None]:
    """Files of this process take no more than a few bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_ROOM, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _words(words: str, out: Path, names: dict[str, str], *more: str) -> list[str]:
    given = {"HERE": str(out.parent / "here"), **names}
    return [given.get(word, word.replace("OUT", str(out))) for word in words.split()] + list(more)


def _target(words: str, out: Path) -> Path:
    """What the command writes."""
    return next(out.with_name(word.replace("OUT", out.name)) for word in words.split() if word.startswith("OUT"))


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Path:
    """A new name in a folder with a split recording, which one of the verbs reads.

    ``capsys``, because a file would take what the verbs print, and no more of that than of the rest.
    """
    monkeypatch.setattr("igtl_gateway.addons.sync.plot.lag_chart", lambda *_: "<svg/>" * 20)  # it takes five seconds
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a truncated module would outlive the test
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "copy.mcap").write_bytes(SMALL.read_bytes())
    return tmp_path / "out"


@pytest.mark.parametrize(
    "words", [pytest.param(words, marks=[pytest.mark.slow] * words.startswith("view")) for words in _COMMANDS]
)
def test_a_full_disk_leaves_what_was_there(words: str, out: Path, names: dict[str, str]) -> None:
    if "--csv" in words or "--parquet" in words or words.startswith("simulate"):
        main(_words(words, out.with_name("warm"), names))  # modules that are loaded at the first use
    target = _target(words, out)
    before = sorted(os.listdir(out.parent))
    with _full_disk():
        code = main(_words(words, out, names))
    assert code == 1
    assert sorted(os.listdir(out.parent)) == before
    if target.suffix:
        target.write_bytes(_OLD)
        if "--to" not in words:
            with _full_disk():
                assert main(_words(words, out, names, "--overwrite")) == 1
        assert target.read_bytes() == _OLD
        assert sorted(os.listdir(out.parent)) == sorted([*before, target.name])


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(words, marks=[pytest.mark.slow] * words.startswith("view"))
        for words in _COMMANDS
        if _target(words, Path("out")).suffix
    ],
)
def test_a_file_is_replaced_only_where_that_is_asked_for(words: str, out: Path, names: dict[str, str]) -> None:
    target = _target(words, out)
    target.write_bytes(_OLD)
    assert main(_words(words, out, names)) == USAGE
    assert target.read_bytes() == _OLD
    if "--to" in words:
        return
    target.unlink()
    victim = out.with_name("victim")
    victim.write_bytes(_OLD)
    target.symlink_to(victim)
    assert main(_words(words, out, names)) == USAGE
    assert main(_words(words, out, names, "--overwrite")) < USAGE
    assert not target.is_symlink() and target.stat().st_size > 0
    assert victim.read_bytes() == _OLD, "a link was followed"
    assert not [name for name in os.listdir(out.parent) if name.startswith(".")]


@pytest.mark.slow
@pytest.mark.usefixtures("terminal_signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_program_that_is_ended(tmp_path: Path, number: signal.Signals) -> None:
    """It is ended when its file is written, and not yet moved."""
    out = tmp_path / "out.mcap"
    out.write_bytes(_OLD)
    code = (
        "import sys, time\n"
        "from igtl_gateway.record.sessionfile import whole_files\n"
        "def wait(*_, **__):\n"
        "    print('now', flush=True)\n"
        "    time.sleep(60)\n"
        "whole_files._move = wait\n"
        "from igtl_gateway.cli import main\n"
        "sys.exit(main())\n"
    )
    words = ["deidentify", str(SMALL), "-o", str(out), "--overwrite"]
    with subprocess.Popen(
        [sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout
        assert program.stdout.readline() == "now\n"
        program.send_signal(number)
        _, errors = program.communicate(timeout=60)
    left = [name for name in os.listdir(tmp_path) if name != out.name]
    assert out.read_bytes() == _OLD
    assert bool(left) is (number is signal.SIGKILL)
    if number is not signal.SIGKILL:
        assert program.returncode == 1 and errors.strip() == "igtl-gateway deidentify: interrupted"
    assert main([*words]) == 0  # the next run
    assert os.listdir(tmp_path) == [out.name]


#: Where an export of a scene is ended: when the session is read and the pixels are written; when all is written.
_MIDDLE, _END = "igtl_gateway.addons.exchange.scene_out._clock", "igtl_gateway.record.sessionfile.whole_files._move"


@pytest.mark.slow
@pytest.mark.usefixtures("terminal_signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("place", [_MIDDLE, _END])
@pytest.mark.parametrize(
    "words", ["--to mrb -o OUT.mrb", "--to mrml -o OUT", "--to seq.nrrd -o OUT.seq.nrrd --streams in:IMAGE/Image_Probe"]
)
def test_a_scene_whose_export_is_ended_is_not_there(
    tmp_path: Path, words: str, place: str, number: signal.Signals
) -> None:
    module, _, name = place.rpartition(".")
    code = (
        f"import importlib, sys, time\nmodule = importlib.import_module({module!r})\n"
        f"def wait(*_, **__):\n    print('now', flush=True)\n    time.sleep(60)\nmodule.{name} = wait\n"
        "from igtl_gateway.cli import main\nsys.exit(main())\n"
    )
    images = str(FIXTURES / "ultrasound.mcap")
    command = ["export", images, *(word.replace("OUT", str(tmp_path / "out")) for word in words.split())]
    with subprocess.Popen(
        [sys.executable, "-c", code, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout
        assert program.stdout.readline() == "now\n"
        program.send_signal(number)
        _, errors = program.communicate(timeout=60)
    left = os.listdir(tmp_path)
    if number is signal.SIGKILL:
        assert [name[:14] for name in left] == [".igtl-gateway-"]
    else:
        assert (left, errors.strip()) == ([], "igtl-gateway export: interrupted")
    assert main(command) == 0  # the next run
    assert [name[:4] for name in os.listdir(tmp_path)] == ["out" + words.split()[3][3:4]]


#: Functions that open or make a file at the given path.
_OPENING = frozenset({"open_new", "open_text", "write_text", "write_bytes", "empty_file", "create_file", "make_folder"})
#: Module → why what it opens is complete or absent all the same.  Every other module goes through ``whole_files``.
_ELSEWHERE = {
    "record/sessionfile/new_file.py": "the functions themselves",
    "record/sessionfile/whole_files.py": "the hidden folder",
    "record/sessionfile/writer.py": "in a place of its caller; a recording of the bridge grows where it is",
    "record/sessionfile/copying.py": "in a place of its caller",
    "record/sessionfile/seal_copy.py": "in a place of its caller",
    "record/sessionfile/stamped.py": "in a place of its caller",
    "addons/merge/writer.py": "in a place of its caller",
    "record/sessionfile/side_file.py": "moved to its name when it is complete",
    "record/parts.py": "the folder of a recording that grows",
    "addons/cohort/results.py": "parts that count when the manifest lists them; its lock removes the others",
    "addons/cohort/query.py": "in a place of its caller",
    "addons/resim/bisect.py": "in a temporary directory",
    "addons/resim/races.py": "in the temporary directory of its runs",
    "addons/exchange/csv_out.py": "in the folder of an export",
    "addons/exchange/scene_store.py": "in the folder of an export",
    "addons/exchange/scene_in.py": "in a temporary directory",
    "addons/exchange/scene_reading.py": "in the folder of an export",
    "api/recording.py": "in a temporary directory",
    "cli/info_source.py": "in a temporary directory",
    "addons/exchange/rosbag2.py": "in a temporary directory",
    "addons/lerobot/layout.py": "in the folder of a training set",
    "addons/lerobot/video.py": "in the folder of a training set",
    "addons/lerobot/writing.py": "in the folder of a training set",
    "addons/lerobot/native.py": "in the folder of a training set",
    "addons/lerobot/assembling.py": "in the folder of a training set",
    "addons/lerobot/checksums.py": "in the folder of a training set",
}


def _calls(tree: ast.Module, names: frozenset[str]) -> set[str]:
    return {
        node.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names
    }


def test_every_other_module_writes_beside() -> None:
    opening = set()
    for root in TREES:
        for path in root.rglob("*.py"):
            source = path.read_text("utf-8")
            if not any(f"{name}(" in source for name in _OPENING):
                continue
            tree = ast.parse(source)
            if not _calls(tree, _OPENING):
                continue
            name = path.relative_to(root).as_posix()
            opening.add(name)
            if name not in _ELSEWHERE:
                beside = _calls(tree, frozenset({"written", "written_folder", "replaced_folder", "hidden_folder"}))
                assert beside, f"{name}: found a file that is opened at its place, expected sessionfile/whole_files.py"
    assert _ELSEWHERE.keys() <= opening, "rows without a call"
