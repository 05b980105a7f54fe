"""What PLUS sends is one connected space in the viewer: its names of transforms and pictures are those of frames."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.base.buffers import join
from igtl_gateway.config.configuration import Config, PeerRow
from igtl_gateway.replay.verify import verify
from igtl_gateway.wire import Item, Message, encode
from igtl_gateway.wire.image import Image
from igtl_gateway.wire.tracking import TRACKING_DTYPE, TrackingData
from tests.peers import plus_like
from tests.places import ROOT
from tests.script import Script
from tests.tables import table

from .conftest import Draw, Drawn

ADDRESS = "127.0.0.1:18944"
PLUS = Config(peers=(PeerRow(at=ADDRESS, profile="plus"),), cautious=True)
TICKS = 1_700_000_000 << 32
#: Where the pictures are, mm: turned by a right angle, so that a pose is needed.
PLACE = (0.2, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, -0.2, 0.0, 12.0, 34.0, 56.0)


def picture(device: str, ticks: int, version: int, *fields: str) -> bytes:
    items = [Item.of(f"{field}Transform", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1") for field in fields if version > 1]
    image = Image((8, 8, 1), 3, bytes(64), wire_matrix=PLACE)
    return join(encode(Message("IMAGE", device, image, ticks, version, 0, tuple(items))))


def tools(names: tuple[str, ...], ticks: int, version: int, status: str = "OK") -> bytes:
    """Tracking data as ``vtkPlusIgtlMessageCommon::PackTrackingDataMessage`` makes them."""
    elements = np.zeros(len(names), TRACKING_DTYPE)
    elements["name"] = [name.encode()[:20] for name in names]
    elements["matrix"] = [plus_like.PLACE] * len(names)
    items = [Item.of(f"{name}{key}", value) for at, name in enumerate(names)
             for key, value in (("Status", status), ("Index", str(at)))]  # fmt: skip
    device = f"TDATA_{len(names)}Elem"
    message = Message("TDATA", device, TrackingData(elements), ticks, version, 0, tuple(items if version > 1 else ()))
    return join(encode(message))


def session(
    poses: tuple[str, ...],
    pictures: tuple[str, ...],
    tracked: tuple[str, ...] = (),
    *,
    version: int = 2,
    first: bool = False,
) -> Script:
    """A few frames of a server; ``first``: pictures before poses."""
    script = Script(PLUS)
    script.up(1, peer=ADDRESS, role="client")
    for number in range(1, 5):
        ticks = TICKS + number * (1 << 28)
        one = plus_like.frame(number, *poses, version=version)
        other = [picture(device, ticks, version, *poses) for device in pictures]
        sent = [*other, *one] if first else [*one, *other]
        for message in [*sent, *([tools(tracked, ticks, version)] if tracked else [])]:
            script.igtl(message)
    assert verify(iter(script.log), PLUS).good
    return script


def spaces(drawn: Drawn) -> set[str]:
    """The roots of all frames in which rerun has something to draw, by its reader."""
    parents: dict[str, str] = {}
    used: set[str] = set()
    for path, batches in [*drawn.batches.items(), *drawn.static_batches.items()]:
        for batch in batches:
            for row in range(batch.num_rows):
                of = {name: column[row].as_py() for name, column in zip(batch.schema.names, batch.columns, strict=True)}
                child, parent = of.get("Transform3D:child_frame"), of.get("Transform3D:parent_frame")
                if child and parent:
                    parents[child[0]] = parent[0]
                if (frame := of.get("CoordinateFrame:frame")) and not path.startswith("rulers"):
                    used.add(frame[0])
    roots = set()
    for frame in used:
        root = frame
        while root in parents:
            root = parents[root]
        roots.add(root)
    return roots


def of_the_page() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The transforms and pictures of the example of plus.md, named as PLUS names them."""
    text = (ROOT / "docs" / "how-to" / "plus.md").read_text("utf-8")
    part = re.search(r"<PlusOpenIGTLinkServer.*?</PlusOpenIGTLinkServer>", text, re.DOTALL)
    assert part
    poses = tuple(re.findall(r'<Transform Name="(\w+)"', part[0]))
    pictures = re.findall(r'<Image Name="(\w+)" EmbeddedTransformToFrame="(\w+)"', part[0])
    assert len(poses) > 1 and pictures
    return poses, tuple("_".join(names) for names in pictures)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("first", [False, True], ids=["poses first", "pictures first"])
def test_the_example_of_the_page_is_one_space(draw: Draw, version: int, first: bool) -> None:
    poses, pictures = of_the_page()
    script = session(poses, pictures, poses, version=version, first=first)
    drawn = draw(entries=script.log)
    assert spaces(drawn) == {"Tracker"} and list(drawn.view.seen.trees()) == ["Tracker"]
    topics = {shown.topic for shown in drawn.view.seen.trees()["Tracker"]}
    assert {"/igtl/in/Image_Tracker/volume", "/igtl/in/ProbeToTracker/transform"} <= topics


LONG = "NeedleBaseToReferenceFrame"


@table(
    "poses, pictures, tracked, root",
    [
        (("ProbeTo3DTracker", "StylusTo3DTracker"), ("Image_3DTracker",), (), "3DTracker"),
        (("ProbeToTracker-1",), ("Image_Tracker-1",), ("ProbeToTracker-1",), "Tracker_1"),
        (("ProbeToRef_Frame",), ("Image_Ref_Frame", "US_Image_Ref_Frame"), (), "Ref_Frame"),
        (("ImageToProbe", "ProbeToTracker"), ("Image_Image", "Image_Probe"), (), "Tracker"),
        ((LONG, "ProbeToReferenceFrame"), ("Image_ReferenceFrame",), (LONG, "ProbeToReferenceFrame"), "ReferenceFrame"),
    ],
)
def test_names_of_every_form_are_one_space(
    draw: Draw, poses: tuple[str, ...], pictures: tuple[str, ...], tracked: tuple[str, ...], root: str
) -> None:
    for first in (False, True):
        assert spaces(draw(entries=session(poses, pictures, tracked, first=first).log)) == {root}


def test_tools_of_several_parents_are_drawn_in_theirs(draw: Draw) -> None:
    """The array of poses has one frame, in which not all of them are; it is not in a view beside the tools."""
    seen = draw(entries=session((), (), ("ProbeToTracker", "NeedleToTracker", "NeedleTipToNeedle")).log).view.seen
    assert {root: [shown.topic for shown in tree] for root, tree in seen.trees().items()} == {
        "Tracker": ["/igtl/in/TDATA_3Elem/tracking"]
    }


def test_a_long_name_has_its_status(draw: Draw) -> None:
    """The status of a tool stands under its whole name: one out of view is not on /tf."""
    script = session((), (), (LONG,))
    assert any(entry.channel == "/tf" for entry in script.log)
    before = len(script.log)
    script.igtl(tools((LONG,), TICKS + (9 << 28), 2, status="OUT_OF_VIEW"))
    assert not [entry for entry in script.log[before:] if entry.channel == "/tf" and b"NeedleBase" in entry.data()]


def test_poses_are_where_they_were(draw: Draw) -> None:
    drawn = draw(entries=session(("ProbeToTracker",), ()).log)
    (row, *_) = drawn.rows("frames/Probe")
    assert math.isclose(row["Transform3D:translation"][0][0], 0.01, rel_tol=1e-6)
