"""Nodes of a scene as MRML: an XML parser reads what was given, whatever the text."""

from __future__ import annotations

from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.addons.exchange.scene_nodes import Scene, attribute, facts, read_facts

_text = st.text(max_size=12)


@given(_text | st.binary(max_size=9).map(lambda data: data.decode("utf-8", "surrogateescape")))
def test_any_text_is_the_value_of_an_attribute(text: str) -> None:
    """What XML cannot hold is replaced, one by one; line ends and tabs are kept."""
    (read,) = ElementTree.fromstring(f'<a b="{attribute(text)}"/>').attrib.values()
    assert len(read) == len(text)
    for found, given_ in zip(read, text, strict=True):
        assert found == given_ or (found == "\ufffd" and (given_ < " " or given_ >= "\ud800"))
        assert found == given_ or given_ not in "\n\r\t"


def test_numbers_are_values_too() -> None:
    assert (attribute(5), attribute(1.5), attribute('a"<&>')) == ("5", "1.5", "a&quot;&lt;&amp;&gt;")


_name = st.text(st.characters(exclude_characters=":;"), min_size=1, max_size=6)


@given(st.dictionaries(_name, _text, min_size=1, max_size=4))
def test_facts_are_read_as_they_were_written(values: dict[str, str]) -> None:
    assert read_facts(facts(values)) == values


def test_facts_in_the_spelling_of_mrml() -> None:
    assert facts({"a": "1;2", "b": "50%3B"}) == "a:1%3B2;b:50%253B"


def scene() -> tuple[Scene, list[str]]:
    made = Scene()
    first = made.add("Transform", "A & <B>", {"matrix": "1 0", "n": 3})
    second = made.add("Volume", "CT", refers=[("transform", first), ("display", ""), ("storage", "vtkX1")], hidden=True)
    return made, [first, second, made.add("Volume", "MR", node="vtkMRMLScalarVolumeNode9")]


def test_nodes_have_identities_of_their_class() -> None:
    made, nodes = scene()
    assert nodes == ["vtkMRMLTransformNode1", "vtkMRMLScalarVolumeNode1", "vtkMRMLScalarVolumeNode9"]
    assert made.new_id("VolumeDisplay") == "vtkMRMLScalarVolumeDisplayNode1"
    assert made.new_id("Volume") == "vtkMRMLScalarVolumeNode2", "of what was given one, none is used"


def test_a_parser_reads_the_document() -> None:
    made, nodes = scene()
    root = ElementTree.fromstring(made.document())
    assert (root.tag, root.attrib) == ("MRML", {"version": "Slicer5.8.0", "userTags": ""})
    assert [child.tag for child in root] == ["Transform", "Volume", "Volume"]
    first, second, third = (child.attrib for child in root)
    assert first == {
        "id": nodes[0],
        "name": "A & <B>",
        "hideFromEditors": "false",
        "selectable": "true",
        "matrix": "1 0",
        "n": "3",
    }
    assert second["references"] == f"transform:{nodes[0]};storage:vtkX1;", "a role without a node is left out"
    assert (second["hideFromEditors"], "references" in third) == ("true", False)


def test_a_scene_without_nodes() -> None:
    assert list(ElementTree.fromstring(Scene().document())) == []
