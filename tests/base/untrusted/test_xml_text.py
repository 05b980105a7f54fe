"""XML of other people: elements, and nothing that expands or reads files."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import DamagedRecording, LimitExceeded
from igtl_gateway.base.untrusted.limits import FileLimits, limits_in_force
from igtl_gateway.base.untrusted.xml_text import parse_xml
from tests.tables import table

LAUGHS = '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]><a>&c;</a>'
FILE = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>'


def test_elements_have_lines_attributes_children_and_text() -> None:
    root = parse_xml('<?xml version="1.0"?>\n<a x="1 &lt; ä">\n  <b/>two<b y="2"/>\n</a>', "doc")
    assert (root.name, root.line, root.attributes) == ("a", 2, {"x": "1 < ä"})
    assert [(child.line, child.attributes) for child in root.all("b")] == [(3, {}), (3, {"y": "2"})]
    assert root.text.strip() == "two"
    assert root.first("c") is None
    assert parse_xml("<?xml version='1.0' encoding='latin-1'?><a x='ä'/>".encode("latin-1"), "doc").attributes == {
        "x": "ä"
    }


@pytest.mark.parametrize("text", [LAUGHS, FILE, '<!DOCTYPE a SYSTEM "http://127.0.0.1/a.dtd"><a/>', "<!DOCTYPE a><a/>"])
def test_a_document_type_is_rejected(text: str) -> None:
    with pytest.raises(DamagedRecording, match="doc: line 1: found a document type, expected none"):
        parse_xml(text, "doc")


@table(
    "data",
    ["", "<a>", "<a></b>", "<a/><b/>", "a", "<a>&b;</a>", "\0", "<a x='1' x='2'/>", b"\xff\xfe", b"\x80<a/>",
     b"<?xml version='1.0' encoding='ebcdic-x'?><a/>", "\ud800<a/>"],
)  # fmt: skip
def test_what_is_no_xml_is_an_error_with_its_place(data: str | bytes) -> None:
    with pytest.raises(DamagedRecording, match=r"doc: .*found invalid XML: .*, expected a whole document"):
        parse_xml(data, "doc")


@pytest.mark.parametrize(
    ("text", "limit"),
    [("<a>" * 65 + "</a>" * 65, "depth"), ("<a>" + "<b/>" * 90 + "</a>", "count"), ("<a/>" + " " * 5000, "document")],
)
def test_limits(text: str, limit: str) -> None:
    with limits_in_force(FileLimits(document=4096, count=80)), pytest.raises(LimitExceeded, match=f"--limit {limit}="):
        parse_xml(text, "doc")
