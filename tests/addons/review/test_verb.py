"""``review`` on the command line: the recording of the STAR scenario, exit codes, table, CSV and JSON."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from igtl_gateway.addons.review import Material, Review, Thresholds, review_of
from igtl_gateway.cli import main
from igtl_gateway.gateway.log.marks import Mark
from igtl_gateway.record.sessionfile.added_marks import write_marks
from igtl_gateway.record.sessionfile.reader import SessionFile
from igtl_gateway.record.sessionfile.writer import SessionWriter
from igtl_gateway_lab.simulate.star_tissue import PLANTED, STITCHES
from tests.places import FIXTURES

STAR = FIXTURES / "star.mcap"


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, list[dict[str, str]]]:
    """Exit code, JSON and CSV of one run."""
    out = tmp_path_factory.mktemp("review") / "stitches.csv"
    with pytest.MonkeyPatch.context() as patch:
        lines: list[str] = []
        patch.setattr("igtl_gateway.addons.review.verb_run.print_json", lambda value: lines.append(json.dumps(value)))
        code = main(["review", str(STAR), "--json", "-o", str(out)])
    with out.open(newline="", encoding="utf-8") as file:
        return code, lines[0], list(csv.DictReader(file))


def _wrong(plan: dict[str, object]) -> list[int]:
    stitches = plan["stitches"]
    assert isinstance(stitches, list)
    return [stitch["number"] for stitch in stitches if stitch["level"] == "wrong"]


def test_the_planted_stitches_are_found_and_no_others(told: tuple[int, str, list[dict[str, str]]]) -> None:
    code, text, _ = told
    facts = json.loads(text)
    assert _wrong(facts["plans"][0]) == list(PLANTED)
    last = _wrong(facts["plans"][-1])
    assert set(last) < set(PLANTED)  # the planner repairs the errors that are visible
    assert code == (1 if last else 0)
    assert facts["good"] is (not last)
    mended = sorted(set(PLANTED) - set(last))
    assert [(row["number"], row["before"], row["after"]) for row in facts["changes"]] == [
        (number, "wrong", "ok") for number in mended
    ]


def test_json_says_what_was_looked_at_and_how(told: tuple[int, str, list[dict[str, str]]]) -> None:
    facts = json.loads(told[1])
    assert facts["cloud"]["topic"] == "/star/cloud"
    assert (facts["cloud"]["height"], facts["cloud"]["width"]) == (150, 200)
    assert facts["cloud"]["noise"] == "temporal"
    assert 0.17 < facts["cloud"]["noise_mm"]["p10"] < facts["cloud"]["noise_mm"]["median"] < 0.25
    assert facts["tool"] == "suture_tool"
    assert facts["thresholds"]["wrong_mm"] == 1.0
    assert {plan["topic"] for plan in facts["plans"]} == {"/star/plan"}


def test_what_the_arm_did_follows_the_last_plan(told: tuple[int, str, list[dict[str, str]]]) -> None:
    stitches = json.loads(told[1])["plans"][-1]["stitches"]
    done = [
        stitch
        for stitch in stitches
        if stitch["entry"]["executed"]["reached"] and stitch["exit"]["executed"]["reached"]
    ]
    assert [stitch["number"] for stitch in done] == [1, 2, 3]
    for stitch in done:
        assert stitch["entry"]["executed"]["distance_mm"] < 0.1
        assert stitch["exit"]["executed"]["distance_mm"] < 0.1
        assert 2.5 < stitch["driven_depth_mm"] < 3.5  # 2.5 mm below the chord, which runs below the bowl of the tissue


def test_csv_has_a_row_for_each_stitch_of_each_version(told: tuple[int, str, list[dict[str, str]]]) -> None:
    _, text, rows = told
    plans = json.loads(text)["plans"]
    assert [(row["version"], row["stitch"]) for row in rows] == [
        (str(version), str(number)) for version in range(1, len(plans) + 1) for number in range(1, STITCHES + 1)
    ]
    for row, stitch in zip(rows, (each for plan in plans for each in plan["stitches"]), strict=True):
        assert row["level"] == stitch["level"]
        assert float(row["entry_distance_mm"]) == pytest.approx(stitch["entry"]["distance_mm"], abs=1e-4)
        assert row["reasons"] == "; ".join(stitch["reasons"])


def test_the_table_marks_the_stitch_and_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["review", str(STAR), "--plan", "/star/plan_points", "--clouds", "4"])
    text = capsys.readouterr().out
    assert text.startswith(f"{STAR}: {STITCHES} stitches, 2 versions of the plan\n")
    marked = [line.split()[1] for line in text.splitlines() if line.startswith("  ! ")]
    assert marked[: len(PLANTED)] == [str(number) for number in PLANTED]
    assert "mm below the tissue" in text
    assert "the camera reads" in text
    assert "4 of 12 clouds of /star/cloud are used" in text
    assert "wrong → ok" in text
    assert "\x1b" not in text  # colour is for terminals
    assert max(map(len, text.splitlines()[1:])) <= 120
    assert code == 1


def test_phases_name_the_stitches_that_were_made_in_them(
    tmp_path: Path, told: tuple[int, str, list[dict[str, str]]], capsys: pytest.CaptureFixture[str]
) -> None:
    stitches = json.loads(told[1])["plans"][-1]["stitches"]
    reached = [each for each in stitches if each["entry"]["executed"] and each["entry"]["executed"]["reached"]]
    source = tmp_path / "star.mcap"
    source.symlink_to(STAR)
    with SessionFile.open(source) as file:
        at = reached[0]["entry"]["executed"]["stamp_ns"] - file.start_ns
        span = file.start_ns, file.end_ns
    phases = (("suture-1", at - 10**8, at + 10**8), ("all", 0, span[1] - span[0]), ("4", 1, 2))
    marks = [Mark(label, "", "", span[0] + first, span[0] + last) for label, first, last in phases]
    write_marks(source, marks, *span)
    main(["review", str(source), "--json"])
    found = json.loads(capsys.readouterr().out)["plans"]
    names = {each["label"]: each["mark"] for each in found[-1]["stitches"]}
    assert names[reached[0]["label"]] == "suture-1" and names[reached[1]["label"]] == "all"
    assert names["4"] == "4" and not any(each["mark"] for each in found[0]["stitches"])
    main(["review", str(source)])
    assert f"{reached[0]['label']} (suture-1)" in capsys.readouterr().out


def test_on_a_terminal_it_is_coloured_and_limits_decide(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    code = main(["review", str(STAR), "--wrong-mm", "5", "--look-mm", "1", "--clouds", "4"])
    text = capsys.readouterr().out
    assert code == 0
    assert "\x1b[33m? 9" in text
    assert "\x1b[32mno stitch of the last plan is wrong" in text


@pytest.mark.parametrize(
    ("options", "code", "error"),
    [
        (["--plan", "/none"], 2, "--plan /none: found no pairs of points"),
        (["--cloud", "/none"], 2, "--cloud /none: found no sensor_msgs/PointCloud2"),
        (["--wrong-mm", "0"], 2, "--wrong-mm: found 0, expected more than 0"),
        (["--look-mm", "2"], 2, "--look-mm: found 2.0, expected at most --wrong-mm, 1.0"),
        (["--clouds", "0"], 2, "--clouds: found 0, expected 1 or more"),
    ],
)
def test_what_is_asked_wrongly_is_named(
    options: list[str], code: int, error: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        found = main(["review", str(STAR), *options])
    except SystemExit as end:  # of a value out of range
        found = int(str(end.code))
    assert found == code
    assert error in capsys.readouterr().err


def test_a_session_without_a_cloud_is_a_failure(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "no-cloud.mcap"
    with SessionFile.open(STAR) as file:
        writer = SessionWriter(path, file.session)
        for entry in file.entries():
            if entry.channel != "/star/cloud":
                writer.write(entry)
        writer.close({})
    assert main(["review", str(path)]) == 1
    assert f"{path}: found no point cloud" in capsys.readouterr().err
    assert main(["review", str(tmp_path / "none.mcap")]) == 2


def test_a_table_that_cannot_be_written_is_a_failure(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reviews: list[Review] = []

    def once(material: Material, limits: Thresholds | None) -> Review:
        """The second run writes the review of the first one."""
        reviews.append(reviews[0] if reviews else review_of(material, limits))
        return reviews[-1]

    monkeypatch.setattr("igtl_gateway.addons.review.recorded.review_of", once)
    out = tmp_path / "no-folder" / "out.csv"
    assert main(["review", str(STAR), "-o", str(out), "--clouds", "2"]) == 1
    there = tmp_path / "there.csv"
    there.write_text("mine", "utf-8")
    assert main(["review", str(STAR), "-o", str(there), "--clouds", "2"]) == 2
    assert there.read_text("utf-8") == "mine"
    assert f"cannot write to {out}" in capsys.readouterr().err
