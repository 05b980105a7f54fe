"""The sources that a configuration names, and those that are not there."""

from __future__ import annotations

from igtl_gateway.config.configuration import Config, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert.arms import ArmsRow
from igtl_gateway.gateway.expected import PresentSources, expected_sources, missing_sources
from tests.tables import table

CONFIG = Config(
    to_igtl=(ToIgtlRow(topic="/tol"), ToIgtlRow(topic="/camera/**"), ToIgtlRow(topic="/tol", type="STRING")),
    to_ros=(ToRosRow(device="Prob"), ToRosRow(device="Tool*")),
    tf_out=(TfOutRow(frames=("tip", "/elbow"), base="base"),),
    crtk=(ArmsRow(arms="/PSM1"), ArmsRow(arms="/MTM*")),
)


def test_names_are_expected_and_patterns_are_not() -> None:
    found = [(each.kind, each.name, each.setting) for each in expected_sources(CONFIG, ["/rosuot", "**"])]
    assert found == [
        ("topic", "/tol", "to_igtl[0]"),
        ("frame", "tip", "tf_out[0]"),
        ("frame", "elbow", "tf_out[0]"),
        ("frame", "base", "tf_out[0]"),
        ("arm", "/PSM1", "crtk[0]"),
        ("device", "Prob", "to_ros[0]"),
        ("topic", "/rosuot", "--record-topics"),
    ]


def test_what_is_selected_by_pattern_is_expected_where_it_is_asked_for() -> None:
    found = expected_sources(Config(), included=["IMAGE/*"], excluded=["/tf*", "Camera"], classed=["/video/**"])
    assert {(each.kind, each.name, each.setting, each.is_optional) for each in found} == {
        ("stream", "IMAGE/*", "--record-include", False),
        ("stream", "Camera", "--record-exclude", True),
        ("stream", "/video/**", "--site-class", False),
    }


ALL = {"/tol", "tip", "elbow", "base", "/PSM1", "Prob"}


@table(
    "present, missing",
    [
        (PresentSources(), set()),
        (PresentSources(topics=()), {"/tol", "/PSM1"}),
        (PresentSources(topics=("/tol", "/PSM1/measured_cp")), set()),
        (PresentSources(topics=("/tool", "/PSM1/spatial/measured_cp")), {"/tol"}),
        (PresentSources(frames=("tip", "base")), {"elbow"}),
        (PresentSources(devices=("Probe",)), {"Prob"}),
        (PresentSources((), (), ()), ALL),
    ],
)
def test_what_is_not_there(present: PresentSources, missing: set[str]) -> None:
    assert {each.source.name for each in missing_sources(expected_sources(CONFIG), present)} == missing


def test_the_sentence_has_the_nearest_name() -> None:
    (one,) = missing_sources(expected_sources(CONFIG), PresentSources(devices=("Probe", "Other")))
    assert one.text == "Prob is configured (to_ros[0]), but no peer sends it; did you mean 'Probe'?"
    note = one.note()
    assert (note.code, note.stream, note.data) == ("no_source", "Prob", {"kind": "device", "setting": "to_ros[0]"})
