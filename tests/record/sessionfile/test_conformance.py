"""MCAP's conformance set through the readers and the verbs: counted right, never called damaged."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader

from igtl_gateway.cli import main
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.salvage import Salvage
from tests.files import write_anew
from tests.record.sessionfile import conformance
from tests.tables import table

FILES = list(conformance.files())
#: In the gate every verb reads one of this number of files; all of them with CONFORMANCE=all.
EACH = 1 if os.environ.get("CONFORMANCE") == "all" else 13


def test_they_are_the_published_files() -> None:
    lines = (line.split() for line in conformance.HASHES.read_text("utf-8").splitlines())
    published = {name: digest for digest, name in lines}
    assert len(published) == 416
    assert {file.name: hashlib.sha256(file.data).hexdigest() for file in FILES} == published


def test_the_reader_counts_every_message(tmp_path: Path) -> None:
    for file in FILES:
        write_anew(tmp_path / "a.mcap", file.data)
        with SessionFile.open(tmp_path / "a.mcap") as opened:
            counted = opened.entry_count + sum(channel.count for channel in opened.skipped)
            assert (counted, list(opened.entries())) == (file.messages, []), file.name


def test_salvage_loses_nothing(tmp_path: Path) -> None:
    for file in FILES:
        write_anew(tmp_path / "a.mcap", file.data)
        with Salvage.open(tmp_path / "a.mcap") as opened:
            found = [len(list(each)) for each in (opened.read(), opened.attachments(), opened.metadata())]
            assert found == [file.messages, file.attachments, file.metadata], file.name
            assert opened.report.whole, (file.name, opened.report)


def test_a_recovered_file_has_the_same_messages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in FILES[::EACH]:
        write_anew(tmp_path / "a.mcap", file.data)
        assert main(["recover", str(tmp_path / "a.mcap"), "--overwrite"]) == 0, file.name
        assert "LOST" not in capsys.readouterr().out
        with (tmp_path / "a.recovered.mcap").open("rb") as stream:
            messages = [message for _, _, message in NonSeekingReader(stream).iter_messages()]
        assert len(messages) == file.messages
        assert {message.data for message in messages} <= {b"\1\2\3"}


def test_info_counts_and_says_nothing_of_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in FILES[::EACH]:
        write_anew(tmp_path / "a.mcap", file.data)
        assert main(["info", str(tmp_path / "a.mcap"), "--json"]) == 0, file.name
        told = json.loads(capsys.readouterr().out)
        assert sum(each["count"] for each in told["skipped"]) == file.messages
        assert "damaged" not in told
        assert main(["info", str(tmp_path / "a.mcap")]) == 0
        assert "DAMAGED" not in capsys.readouterr().out


#: Verb → its arguments for FILE, and the exit codes that are right for a file without anything that it can use.
VERBS: dict[str, tuple[list[str], set[int]]] = {
    "verify": (["FILE"], {2}),
    "lint": (["FILE"], {0, 1, 2}),
    "slice": (["FILE", "-o", "OUT"], {2}),
    "diff": (["FILE", "FILE"], {0, 1}),
    "replay": (["FILE", "--to", "igtl", "--listen", "127.0.0.1:0", "--rate", "0"], {2}),
    "import": (["FILE", "-o", "OUT", "--json"], {0, 1}),
    "export": (["FILE", "--to", "csv", "-o", "OUT"], {0, 1, 2}),
    "review": (["FILE"], {0, 1, 2}),
}


@table("verb", VERBS)
def test_every_verb_reads_them_or_says_why_not(tmp_path: Path, capsys: pytest.CaptureFixture[str], verb: str) -> None:
    arguments, codes = VERBS[verb]
    outcomes: Counter[int] = Counter()
    for number, file in enumerate(FILES[::EACH]):
        path = tmp_path / "a.mcap"
        write_anew(path, file.data)
        paths = {"FILE": str(path), "OUT": str(tmp_path / f"{number}.out")}
        code = main([verb, *(paths.get(word, word) for word in arguments)])
        said = capsys.readouterr()
        assert code in codes, (file.name, said)
        assert not any(word in said.out + said.err for word in ("Traceback", "DAMAGED", "LOST", "damaged", "cut off"))
        assert code == 0 or said.err.startswith(f"igtl-gateway {verb}: ") or said.out, file.name
        if verb == "import" and code:
            assert "found no message to import" in said.err and not Path(paths["OUT"]).exists()
        elif verb == "import":
            rows = json.loads(said.out)["rows"]
            assert sum(each["declared"] for each in rows if each["unit"] == "messages") == file.messages
        outcomes[code] += 1
    assert sum(outcomes.values()) == len(FILES[::EACH])
