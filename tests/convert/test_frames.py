"""FrameTree against 4 × 4 matrices in numpy, and the words of --tf-out."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert import frames as module
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.frames import CYCLE, HISTORY_NS, MAX_DEPTH, TOO_DEEP, FrameTree, TfRequest, in_frame
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Pose
from igtl_gateway.convert.units import LengthUnits
from igtl_gateway.wire.tracking import QuaternionTrackingData, TrackingData
from tests.tables import table

H = math.sqrt(0.5)
S = 1_000_000_000
Matrix = npt.NDArray[Any]

#: (parent, child, stamp_ns, pose)
Sample = tuple[str, str, int, Pose]


def at(x: float, y: float = 0.0, z: float = 0.0, q: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> Pose:
    return (x, y, z, *q)


def message(*samples: Sample) -> TFMessage:
    return TFMessage(tuple(FrameTransform(Header(ns, parent), child, pose) for parent, child, ns, pose in samples))


def tree(*samples: Sample, static: tuple[Sample, ...] = ()) -> FrameTree:
    made = FrameTree()
    made.update(message(*static), True)
    for sample in samples:
        made.update(message(sample), False)
    return made


# -- the oracle: matrices of numpy, a plain list of samples ------------------------------------------------------


def matrix(pose: Pose) -> Matrix:
    """By Rodrigues' formula, so that nothing is shared with the code under test."""
    q = np.array(pose[3:]) / np.linalg.norm(pose[3:])
    angle = 2.0 * math.atan2(float(np.linalg.norm(q[:3])), q[3])
    axis = q[:3] / np.linalg.norm(q[:3]) if np.linalg.norm(q[:3]) > 0.0 else np.zeros(3)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    result = np.eye(4)
    result[:3, :3] = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
    result[:3, 3] = pose[:3]
    return result


def assert_pose(pose: Pose, expected: Matrix) -> None:
    scale = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(matrix(pose), expected, atol=1e-9 * scale)
    assert math.sqrt(sum(v * v for v in pose[3:])) == pytest.approx(1.0, abs=1e-14)


def to_root(parents: dict[str, tuple[str, Matrix]], frame: str) -> Matrix:
    result: Matrix = np.eye(4)
    while frame in parents:
        frame, step = parents[frame]
        result = step @ result
    return result


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 1e-3)
poses = st.builds(lambda t, q: (*t, *q), st.tuples(*[st.floats(-10, 10)] * 3), quaternions)


@st.composite
def trees(draw: st.DrawFn) -> list[tuple[str, str, bool, Pose]]:
    """(parent, child, static, pose) of a random tree of frames f0 … fn, in any order."""
    size = draw(st.integers(1, 8))
    edges = [
        (f"f{draw(st.integers(0, child - 1))}", f"f{child}", draw(st.booleans()), draw(poses))
        for child in range(1, size + 1)
    ]
    return draw(st.permutations(edges))


@given(trees(), st.data())
def test_any_two_frames_of_any_tree(edges: list[tuple[str, str, bool, Pose]], data: st.DataObject) -> None:
    made = FrameTree()
    for parent, child, static, pose in edges:
        made.update(message((parent, child, 5 * S, pose)), static)
    parents = {child: (parent, matrix(pose)) for parent, child, _, pose in edges}
    frames = [f"f{number}" for number in range(len(edges) + 1)]
    target, base = data.draw(st.sampled_from(frames)), data.draw(st.sampled_from(frames))
    found = made.latest(target, base)
    assert found is not None
    stamp_ns, pose = found
    assert_pose(pose, np.linalg.inv(to_root(parents, base)) @ to_root(parents, target))
    chain = made.chain(target, base)
    assert chain is not None
    moving = {child for _, child, static, _ in edges if not static}
    assert stamp_ns == (5 * S if moving & {*chain[0], *chain[1]} else 0)


@given(
    st.lists(st.tuples(st.integers(1, 9 * S), poses), min_size=1, max_size=6, unique_by=lambda s: s[0]),
    st.lists(st.tuples(st.integers(1, 9 * S), poses), min_size=1, max_size=6, unique_by=lambda s: s[0]),
)
def test_latest_common_time(first: list[tuple[int, Pose]], second: list[tuple[int, Pose]]) -> None:
    """Samples in any order; each edge interpolated at the older one of the two newest stamps."""
    made = tree(*[("a", "b", *sample) for sample in first], *[("b", "c", *sample) for sample in second])
    time = min(max(ns for ns, _ in first), max(ns for ns, _ in second))
    found = made.latest("c", "a")
    if any(min(ns for ns, _ in samples) > time for samples in (first, second)):
        assert found is None
    else:
        assert found is not None and found[0] == time
        assert_pose(found[1], interpolated(first, time) @ interpolated(second, time))


def interpolated(samples: list[tuple[int, Pose]], time: int) -> Matrix:
    samples = sorted(samples)
    for (start, a), (end, b) in pairwise(samples):
        if start < time < end:
            share = (time - start) / (end - start)
            p, q = np.array(a), np.array(b)
            p[3:] /= np.linalg.norm(p[3:])
            q[3:] /= np.linalg.norm(q[3:])
            if p[3:] @ q[3:] < 0:
                q[3:] = -q[3:]
            x, y, z, *rotation = ((1 - share) * p + share * q).tolist()
            return matrix((x, y, z, *rotation))
    return matrix(dict(samples)[time])


# -- by hand ------------------------------------------------------------------------------------------------------


def test_golden_chain() -> None:
    """A camera 1 m above the base, turned a quarter about z; the tool 2 m along the camera's x: 2 m along y."""
    made = tree(
        ("camera", "tool", 7 * S, at(2.0)),
        static=(("base", "camera", 0, at(0.0, 0.0, 1.0, (0.0, 0.0, H, H))),),
    )
    found = made.latest("tool", "base")
    assert found is not None
    assert found[0] == 7 * S
    assert found[1] == pytest.approx((0, 2, 1, 0, 0, H, H), abs=1e-15)
    back = made.latest("base", "tool")
    assert back is not None
    assert back[1] == pytest.approx((-2, 0, -1, 0, 0, -H, H), abs=1e-15) or back[1] == pytest.approx(
        (-2, 0, -1, 0, 0, H, -H), abs=1e-15
    )


def test_one_edge_is_told_to_the_bit() -> None:
    pose = (0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8)
    assert tree(("a", "b", 3, pose)).latest("b", "a") == (3, pose)


def test_a_frame_in_itself() -> None:
    assert tree(("a", "b", 3, at(1.0))).latest("b", "b") == (0, at(0.0))


def test_chain_ends_at_the_common_ancestor() -> None:
    made = tree(*[(parent, child, 1, at(1.0)) for parent, child in ("ra", "ab", "bc", "ad", "xy")])
    assert made.chain("c", "d") == (("c", "b"), ("d",))
    assert made.chain("d", "c") == (("d",), ("c", "b"))
    assert made.chain("c", "r") == (("c", "b", "a"), ())
    assert made.chain("r", "c") == ((), ("c", "b", "a"))
    for missing in ("y", "nowhere"):
        assert made.chain("c", missing) is None
        assert made.latest(missing, "c") is None
        assert made.version("c", missing) == 0


def test_edges_above_the_common_ancestor_do_not_count() -> None:
    """The root's edge is older; between siblings it does not matter."""
    made = tree(("r", "a", 1 * S, at(9.0)), ("a", "b", 5 * S, at(1.0)), ("a", "c", 5 * S, at(0.0, 1.0)))
    assert made.latest("b", "c") == (5 * S, at(1.0, -1.0))


def test_rotations_take_the_short_way() -> None:
    """From 0 to +90° about z, given as the quaternion of the far side: half-way is 45°."""
    made = tree(("a", "b", S, at(0.0)), ("a", "b", 3 * S, at(4.0, q=(0.0, 0.0, -H, -H))), ("b", "c", 2 * S, at(0.0)))
    found = made.latest("c", "a")
    assert found is not None
    assert found[0] == 2 * S
    assert found[1] == pytest.approx((2, 0, 0, 0, 0, math.sin(math.pi / 8), math.cos(math.pi / 8)), abs=1e-15)


@pytest.mark.parametrize("share", [0.1, 0.21, 0.5, 0.9])
def test_normalised_interpolation_stays_near_the_great_circle(share: float) -> None:
    end = at(0.0, q=(math.sin(0.05), 0.0, 0.0, math.cos(0.05)))  # 0.1 rad about x
    time = S + round(share * S)
    made = tree(("a", "b", S, at(0.0)), ("a", "b", 2 * S, end), ("b", "c", time, at(0.0)))
    found = made.latest("c", "a")
    assert found is not None
    assert 2 * math.atan2(found[1][3], found[1][6]) == pytest.approx(0.1 * share, abs=1e-5)


def test_leading_slashes_mean_nothing() -> None:
    made = tree(("/a", "/b", 3, at(1.0)), ("a", "b", 4, at(2.0)))
    assert made.latest("b", "a") == (4, at(2.0))


def test_samples_in_any_order_and_twice() -> None:
    made = tree(("a", "b", 3, at(3.0)), ("a", "b", 1, at(1.0)), ("a", "b", 2, at(7.0)), ("a", "b", 2, at(2.0)))
    assert made.latest("b", "a") == (3, at(3.0))
    made.update(message(("b", "c", 2, at(0.0))), False)
    assert made.latest("c", "a") == (2, at(2.0))  # the second sample of time 2


def test_quaternions_of_any_length() -> None:
    assert tree(("a", "b", 1, at(0.0, q=(0.0, 0.0, 3.0, 4.0)))).latest("b", "a") == (1, at(0.0, q=(0.0, 0.0, 0.6, 0.8)))


# -- life of an edge ----------------------------------------------------------------------------------------------


def test_a_sample_without_stamp_holds_at_all_times() -> None:
    made = tree(("a", "b", 0, at(1.0)), ("b", "c", 9 * S, at(1.0)), ("a", "b", 0, at(2.0)))
    assert made.latest("b", "a") == (0, at(2.0))
    assert made.latest("c", "a") == (9 * S, at(3.0))


def test_a_static_edge_keeps_its_newest_sample_whatever_its_stamp() -> None:
    made = tree(static=(("a", "b", 9 * S, at(1.0)), ("a", "b", 2 * S, at(2.0))))
    assert made.latest("b", "a") == (0, at(2.0))


def test_an_edge_may_change_between_static_and_dynamic() -> None:
    made = tree(("a", "b", S, at(1.0)))
    made.update(message(("a", "b", 2 * S, at(2.0))), True)
    assert made.latest("b", "a") == (0, at(2.0))
    made.update(message(("a", "b", 3 * S, at(3.0))), False)
    assert made.latest("b", "a") == (3 * S, at(3.0))


def test_a_new_parent_starts_anew() -> None:
    made = tree(("a", "c", S, at(1.0)), ("b", "c", 2 * S, at(2.0)), ("b", "d", S, at(0.0)))
    assert made.latest("c", "a") is None
    assert made.latest("c", "b") == (2 * S, at(2.0))
    assert made.latest("c", "d") is None  # the sample of second 1 belonged to another parent


def test_an_edge_forgets_what_is_older_than_the_history() -> None:
    made = tree(("a", "b", S, at(1.0)), ("b", "c", S, at(0.0)))
    made.update(message(("a", "b", S + HISTORY_NS, at(2.0))), False)
    assert made.latest("c", "a") == (S, at(1.0))
    made.update(message(("a", "b", S + HISTORY_NS + 1, at(3.0))), False)
    assert made.latest("c", "a") is None
    made.update(message(("b", "c", S + HISTORY_NS, at(0.0))), False)
    assert made.latest("c", "a") == (S + HISTORY_NS, at(2.0))


def test_a_bag_that_begins_again_clears_the_edge() -> None:
    made = tree(("a", "b", 100 * S, at(1.0)), ("a", "b", 90 * S - 1, at(2.0)))
    assert made.latest("b", "a") == (90 * S - 1, at(2.0))
    made = tree(("a", "b", 100 * S, at(1.0)), ("a", "b", 90 * S, at(2.0)))
    assert made.latest("b", "a") == (100 * S, at(1.0))  # late, but not that late


def test_bound_of_samples() -> None:
    made = FrameTree(max_samples=3)
    for ns in (1, 2, 3, 4):
        made.update(message(("a", "b", ns, at(float(ns)))), False)
    for time, found in ((1, None), (2, (2, at(2.0)))):
        made.update(message(("b", f"c{time}", time, at(0.0))), False)
        assert made.latest(f"c{time}", "a") == found


def test_bound_of_all_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond it an edge has its last two samples, which still give the latest pose."""
    monkeypatch.setattr(module, "MAX_ALL_SAMPLES", 10)
    made = FrameTree()
    for ns in range(1, 9):
        for child in "bcd":
            made.update(message(("a", child, ns, at(float(ns)))), False)
    assert made._samples == sum(len(edge.stamps) for edge in made._edges.values()) <= 10
    assert made.latest("d", "b") == (8, at(0.0))
    made.update(message(("a", "b", 100 * S, at(0.0)), ("x", "c", 1, at(0.0)), ("a", "d", 2 * S, at(0.0))), False)
    made.update(message(("a", "d", 3 * S, at(0.0))), True)
    assert made._samples == sum(len(edge.stamps) for edge in made._edges.values())


def test_bound_of_frames() -> None:
    made = FrameTree(max_frames=2)
    made.update(message(*[("a", child, 1, at(1.0)) for child in "bcde"]), False)
    assert made.refused == {"too_many_frames": 2}
    made.update(message(("b", "c", 2, at(5.0))), False)  # the known ones live on, also under another parent
    assert made.latest("c", "b") == (2, at(5.0))
    assert made.refused == {"too_many_frames": 2}


# -- what is refused ----------------------------------------------------------------------------------------------


@table(
    ("sample", "reason"),
    [
        (("", "x", 1, at(0.0)), "no_frame_name"),
        (("x", "/", 1, at(0.0)), "no_frame_name"),
        (("x", "y", 1, at(math.nan)), "not_a_pose"),
        (("x", "y", 1, at(0.0, 0.0, -math.inf)), "not_a_pose"),
        (("x", "y", 1, at(0.0, q=(0.0, 0.0, 0.0, 0.0))), "not_a_pose"),
        (("x", "y", 1, at(0.0, q=(0.0, math.nan, 0.0, 1.0))), "not_a_pose"),
        (("x", "y", 1, at(0.0, q=(0.0, 1e200, 0.0, 1.0))), "not_a_pose"),
        (("x", "x", 1, at(0.0)), "cycle"),
        (("b", "a", 1, at(0.0)), "cycle"),
        (("c", "a", 1, at(0.0)), "cycle"),
        (("c", "b", 1, at(0.0)), "cycle"),
    ],
)
def test_refused(sample: Sample, reason: str) -> None:
    """Only this transform is rejected: the tree and its neighbour in the message are unchanged."""
    made = tree(("a", "b", 1, at(1.0)), ("b", "c", 1, at(1.0)))
    before = made.version("c", "a")
    made.update(message(sample, ("b", "d", 1, at(2.0))), False)
    assert made.refused == {reason: 1}
    assert (made.latest("c", "a"), made.version("c", "a")) == ((1, at(2.0)), before)
    assert made.latest("d", "a") == (1, at(3.0))
    assert made.chain("x", "y") is None


# -- version ------------------------------------------------------------------------------------------------------


def test_version_tells_of_every_change_and_of_no_other() -> None:
    made = tree(("a", "b", 1, at(1.0)), ("a", "c", 1, at(1.0)))
    seen = [made.version("b", "c")]

    def changed(*sample: Any, static: bool = False) -> bool:
        made.update(message(sample), static)
        seen.append(made.version("b", "c"))
        return seen[-1] != seen[-2]

    assert changed("a", "b", 2, at(2.0))
    assert changed("a", "c", 2, at(2.0))
    assert not changed("b", "d", 2, at(2.0))
    assert not changed("r", "a", 2, at(2.0))
    assert changed("x", "c", 3, at(2.0))
    assert seen[-1] == 0
    assert changed("r", "x", 3, at(2.0))  # connected again, another way round
    assert made.chain("b", "c") == (("b", "a"), ("c", "x"))
    assert changed("r", "a", 4, at(2.0), static=True)


@given(trees(), st.lists(st.tuples(st.integers(0, 8), st.integers(1, 8), st.booleans(), poses), max_size=12))
def test_equal_version_means_equal_answer(
    edges: list[tuple[str, str, bool, Pose]], more: list[tuple[int, int, bool, Pose]]
) -> None:
    made = FrameTree()
    seen: dict[int, Any] = {}
    changes = edges + [(f"f{parent}", f"f{child}", static, pose) for parent, child, static, pose in more]
    for step, (parent, child, static, pose) in enumerate(changes, start=1):
        made.update(message((parent, child, step, pose)), static)
        answer = made.latest("f1", "f2")
        assert seen.setdefault(made.version("f1", "f2"), answer) == answer


# -- requests -----------------------------------------------------------------------------------------------------


@table(
    ("text", "expected"),
    [
        ("tool:base", TfRequest(("tool",), "base", "toolTobase", "TRANSFORM")),
        (" /tool : /base ", TfRequest(("tool",), "base", "toolTobase", "TRANSFORM")),
        ("tool:base=Device", TfRequest(("tool",), "base", "Device", "TRANSFORM")),
        ("tool:base=Device:TDATA", TfRequest(("tool",), "base", "Device", "TDATA")),
        ("tool:base=Device:POSITION", TfRequest(("tool",), "base", "Device", "POSITION")),
        ("a,b:base=Tracker:TDATA", TfRequest(("a", "b"), "base", "Tracker", "TDATA")),
        ("a, b:base=Tracker:QTDATA", TfRequest(("a", "b"), "base", "Tracker", "QTDATA")),
        ("a,b:base", TfRequest(("a", "b"), "base", "ToolsTobase", "TDATA")),
        (
            "ur5/tool0:ur5/base_link",
            TfRequest(("ur5/tool0",), "ur5/base_link", "ur5/tool0Tour5/base_link", "TRANSFORM"),
        ),
    ],
)
def test_requests(text: str, expected: TfRequest) -> None:
    assert TfRequest.parse(text) == expected
    assert TfRequest.parse(expected.text()) == expected


@table(
    ("text", "found"),
    [
        ("", "''"),
        ("tool", "'tool'"),
        ("tool:", "'tool:"),
        (":base", "':base"),
        ("a,,b:base", "'a,,b:base"),
        ("a:b:c", "'a:b:c'"),
        ("tool:base=", "'tool:base='"),
        ("tool:base=:TDATA", "'tool:base=:TDATA'"),
        ("tool:base=Device:", "'tool:base=Device:'"),
        ("tool:base=Device:IMAGE", "type 'IMAGE'"),
        ("a,b:base=Device:TRANSFORM", "2 frames as TRANSFORM"),
        ("a,b:base=Device:POSITION", "2 frames as POSITION"),
        ("tool:tool", "'tool:tool="),
        ("tool:/tool", "'tool:tool="),
        ("a,b,a:base", "'a,b,a:base="),
    ],
)
def test_requests_that_are_none(text: str, found: str) -> None:
    with pytest.raises(ConfigError, match=r"--tf-out: found .*, expected ") as error:
        TfRequest.parse(text)
    assert f"found {found}" in str(error.value)


def test_a_chain_of_frames_has_a_bound() -> None:
    """Else each frame of a message of thousands would walk along all above it; and a cycle is found up to there."""
    tree, links = FrameTree(), [("f0", "f1"), *((f"f{number}", f"f{number + 1}") for number in range(1, 400))]
    tree.update(TFMessage(tuple(FrameTransform(Header(1, parent), child, at(0.0)) for parent, child in links)), False)
    assert tree.refused == {TOO_DEEP: 1}  # what follows it is a tree of its own
    assert len(tree.names()) > 400 > MAX_DEPTH
    tree.update(TFMessage((FrameTransform(Header(2, "f200"), "f0", at(0.0)),)), False)
    assert tree.refused[CYCLE] == 1


@pytest.mark.parametrize("unit", ["mm", "m"])
def test_tracking_data_in_another_frame_is_what_matrices_give(unit: str) -> None:
    """In both forms: a matrix for each tool, or a position and a quaternion."""
    pose = at(0.1, -0.2, 0.3, (0.5, -0.5, 0.5, 0.5))
    tools = [at(1.0, 2.0, 3.0, (0.0, 0.0, 0.6, 0.8)), at(-4.0, 5.0, 6.0, (1.0, 0.0, 0.0, 0.0))]
    ratio = 1000.0 if unit == "mm" else 1.0
    lengths = LengthUnits(igtl=unit)
    expected = []
    for tool in tools:
        moved = matrix(pose)
        moved[:3, 3] *= ratio
        expected.append(moved @ matrix(tool))
    quaternions = np.zeros(2, QuaternionTrackingData.DTYPE)
    matrices = np.zeros(2, TrackingData.DTYPE)
    for row, tool in enumerate(tools):
        quaternions[row]["position"], quaternions[row]["quaternion"] = tool[:3], tool[3:]
        whole = matrix(tool)
        matrices[row]["matrix"] = (*whole[:3, :3].T.reshape(-1), *whole[:3, 3])
        quaternions[row]["name"] = matrices[row]["name"] = b"Tool"
    found = in_frame(TrackingData(matrices), pose, lengths)
    assert isinstance(found, TrackingData)
    for row, whole in enumerate(expected):
        np.testing.assert_allclose(
            found.elements["matrix"][row], (*whole[:3, :3].T.reshape(-1), *whole[:3, 3]), atol=1e-4
        )
    found = in_frame(QuaternionTrackingData(quaternions), pose, lengths)
    assert isinstance(found, QuaternionTrackingData)
    for row, whole in enumerate(expected):
        one = found.elements[row]
        moved = matrix((*one["position"].tolist(), *one["quaternion"].tolist()))
        np.testing.assert_allclose(moved, whole, atol=1e-4)
    assert (matrices["matrix"][0][9:] == tools[0][:3]).all(), "what was given stays"
