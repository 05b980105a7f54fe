"""The pictures of the documentation, made from the recordings in fixtures/ by the viewer itself, without a screen.

    .venv/bin/python tools/pictures.py               all of them, into docs/pictures
    .venv/bin/python tools/pictures.py star lego     these

A picture that a view of the viewer complains about is an error: it would show readers something broken.  Pictures are
reduced to 256 colours, which no eye sees on these and which makes them a third of the size.
"""

from __future__ import annotations

import io
import sys
import tempfile
from contextlib import redirect_stdout
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av

from igtl_gateway.addons.view.shots import HeadlessViewer
from igtl_gateway.base.errors import GatewayError
from igtl_gateway.cli import main as igtl_gateway

ROOT = Path(__file__).parent.parent
PICTURES = ROOT / "docs" / "pictures"
SIZE = (1280, 800)
LIMIT = 400_000  #: bytes: a page with several of them should still open at once
_BAR = 36  #: height of the empty title bar, pixels


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture.

    Attributes:
        name: of its file.
        fixture: the recording that it shows, or the scenario if there is no such recording.
        part: when, as part of the recording's time, 0 … 1.
    """

    name: str
    fixture: str
    part: float


TABLE = (
    Picture("star", "star", 0.1),
    Picture("star-corrected", "star", 0.55),
    Picture("lego", "lego", 0.85),
    Picture("ultrasound", "ultrasound", 0.6),
    Picture("brain", "brain", 0.9),
    Picture("acquisition", "acquisition", 0.97),
    Picture("crtk", "crtk", 0.8),
)


def main(names: list[str]) -> int:
    """Make the pictures of these names, or all; 1 where one is not as it should be."""
    known = {picture.name: picture for picture in TABLE}
    if unknown := [name for name in names if name not in known]:
        print(f"found {', '.join(unknown)}, expected some of {', '.join(known)}", file=sys.stderr)
        return 2
    PICTURES.mkdir(exist_ok=True)
    faults = 0
    for name in names or known:
        try:
            faults += not make(known[name])
        except GatewayError as error:
            print(f"{name}: {error}", file=sys.stderr)
            return 1
    return 1 if faults else 0


def make(picture: Picture) -> bool:
    """Make one; whether no view complained and it is small enough.  Raises GatewayError."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / f"{picture.fixture}.rrd"
        fixture = ROOT / "fixtures" / f"{picture.fixture}.mcap"
        with redirect_stdout(io.StringIO()):
            if not fixture.exists():
                fixture = Path(folder) / fixture.name
                igtl_gateway(["simulate", picture.fixture, "-o", str(fixture)])
            failed = igtl_gateway(["view", str(fixture), "-o", str(recording)])
        if failed:
            raise GatewayError(f"cannot draw {fixture}")
        with HeadlessViewer(recording, SIZE) as viewer:
            shot = viewer.shot(viewer.at(picture.part))
    png = reduced(shot.png)
    out = PICTURES / f"{picture.name}.png"
    out.write_bytes(png)
    print(f"{out.relative_to(ROOT)}: {len(png) / 1000:.0f} kB", *shot.complaints, sep="\n  ! ", flush=True)
    if len(png) > LIMIT:
        print(f"  ! larger than {LIMIT / 1000:.0f} kB")
    return not shot.complaints and len(png) <= LIMIT


def reduced(png: bytes) -> bytes:
    """The picture without the viewer's title bar, in 256 colours of its own."""
    with av.open(io.BytesIO(png)) as source:
        frame = next(source.decode(video=0)).reformat(format="rgb24")
    graph = av.filter.Graph()
    start = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 25))
    crop = graph.add("crop", f"{frame.width}:{frame.height - _BAR}:0:{_BAR}:exact=1")
    split, palette = graph.add("split"), graph.add("palettegen", "reserve_transparent=0:stats_mode=full")
    use, sink = graph.add("paletteuse", "dither=none"), graph.add("buffersink")
    start.link_to(crop)
    crop.link_to(split)
    split.link_to(palette, 0)
    split.link_to(use, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    start.push(frame)
    start.push(None)
    coloured = sink.pull()
    out = io.BytesIO()
    with av.open(out, "w", format="image2pipe") as target:
        stream = target.add_stream("png", rate=1)
        stream.width, stream.height, stream.pix_fmt = coloured.width, coloured.height, coloured.format.name
        stream.options = {"compression_level": "9", "pred": "none"}
        for packet in (*stream.encode(coloured), *stream.encode(None)):
            target.mux(packet)
    return out.getvalue()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
