"""Pictures by the viewer itself: at the time asked for, with what its views complain of, and no viewer left behind."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from igtl_gateway.addons.view.shots import TIME_LINE, HeadlessViewer, take_shots
from igtl_gateway.base.errors import ViewerError
from igtl_gateway.cli import main as igtl_gateway
from tests.places import FIXTURES

rr = pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")
rrb = pytest.importorskip("rerun.blueprint")

SIZE = (400, 300)
RED_NS, BLUE_NS = 1_000_000_000, 3_000_000_000


def a_recording(path: Path, time_line: str = TIME_LINE) -> Path:
    """A red picture, two seconds later a blue one; one view of it, and a 3-D view that asks for an unknown frame."""
    stream = rr.RecordingStream("test", recording_id="test", send_properties=False)
    stream.save(path)
    for time_ns, colour in ((RED_NS, (255, 0, 0)), (BLUE_NS, (0, 0, 255))):
        stream.set_time(time_line, timestamp=np.datetime64(time_ns, "ns"))
        stream.log("picture", rr.Image(np.full((30, 40, 3), colour, np.uint8)))
        stream.log("points", rr.Points3D([(0, 0, 0)]))
    lost = rrb.Spatial3DView(
        name="lost", origin="/points", spatial_information=rrb.SpatialInformation(target_frame="nowhere")
    )
    picture = rrb.Spatial2DView(name="picture", origin="/picture")
    stream.send_blueprint(rrb.Blueprint(rrb.Vertical(picture, lost), rrb.TimePanel(state="hidden")))
    stream.flush()
    stream.disconnect()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return a_recording(tmp_path_factory.mktemp("shots") / "two.rrd")


def has_gone(pid: int) -> bool:
    """Within ten seconds; a process whose exit status its parent has not collected has ended, too."""
    for _ in range(100):
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except OSError:
            return True
        Event().wait(0.1)
    return False


@pytest.fixture(scope="module")
def driver(recording: Path) -> None:
    """Skips where there is nothing to draw with."""
    try:
        HeadlessViewer(recording, SIZE).close()
    except ViewerError as error:
        if "Vulkan" not in str(error):
            raise
        pytest.skip(str(error))


def test_a_picture_at_each_time_and_what_the_views_complain_of(recording: Path, driver: None) -> None:
    with HeadlessViewer(recording, SIZE) as viewer:
        pid = viewer.pid
        assert (viewer.first_ns, viewer.last_ns, viewer.at(0.5)) == (RED_NS, BLUE_NS, (RED_NS + BLUE_NS) // 2)
        red, between, blue = (viewer.shot(time_ns) for time_ns in (RED_NS, BLUE_NS - 1, BLUE_NS))
    assert struct.unpack(">II", red.png[16:24]) == SIZE
    assert red.png == between.png != blue.png
    assert [(complaint.view, complaint.severity) for complaint in blue.complaints] == [("lost", "error")]
    assert "nowhere" in blue.complaints[0].text
    assert has_gone(pid)


def test_without_a_driver_the_error_says_what_to_install(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nowhere.json")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    with pytest.raises(ViewerError, match=r"no usable Vulkan driver.*apt-get install .*mesa-vulkan-drivers"):
        take_shots(recording, [None], SIZE)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ViewerError, match="no such file"):
        take_shots(tmp_path / "none.rrd", [None])


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's doing")
def test_the_viewer_dies_with_a_killed_program(recording: Path) -> None:
    program = (
        "import os, signal, sys; from pathlib import Path; from igtl_gateway.addons.view import shots\n"
        "process = shots._start(Path(sys.argv[1]), (400, 300)); process.ready.wait(50)\n"
        "print(process.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program, str(recording)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        timeout=60,
        check=False,
    )
    assert ended.returncode == -signal.SIGKILL
    assert has_gone(int(ended.stdout))


def test_no_view_complains_about_the_suturing_session(tmp_path: Path, driver: None) -> None:
    recording = tmp_path / "star.rrd"
    assert igtl_gateway(["view", str(FIXTURES / "star.mcap"), "-o", str(recording), "--json"]) == 0
    with HeadlessViewer(recording, SIZE) as viewer:
        # before the first message, when no frame is known yet, and in the middle of it all
        start, sewing = (viewer.shot(viewer.at(part)) for part in (0.0, 0.5))
    assert (start.complaints, sewing.complaints) == ((), ())
    assert start.png != sewing.png
