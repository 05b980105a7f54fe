"""Robots: where their links are against kinematics of its own, who moves them, what is not drawn."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any
from xml.etree import ElementTree  # of the test's own text

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("rerun", reason="rerun is not installed (extra 'view')")

from igtl_gateway.addons.view import blueprints
from igtl_gateway.addons.view.contents import EntityKind
from igtl_gateway.addons.view.meshes import MeshFolders
from igtl_gateway.addons.view.urdf import parse_urdf
from igtl_gateway.base.errors import DamagedRecording, LimitExceeded, UnsupportedRecording
from igtl_gateway.convert.common_msgs import FrameTransform, JointState, TFMessage
from igtl_gateway.convert.rosmsg import Header, String

from .conftest import Draw, Drawn

Array = npt.NDArray[Any]
BALL = '<visual><geometry><sphere radius="0.01"/></geometry></visual>'
STL = bytes(80) + struct.pack("<I", 1) + bytes(50)


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{more}</joint>'


def urdf(*joints: str, links: str = "world a b", body: str = BALL, name: str = "arm") -> str:
    each = "".join(f'<link name="{link}">{body}</link>' for link in links.split())
    return f'<robot name="{name}">{each}{"".join(joints)}</robot>'


ARM = urdf(
    joint("base", "world", "a", "fixed", '<origin xyz="0 0 1"/>'),
    joint("yaw", "a", "b", "revolute", '<origin xyz="0.1 0 0"/><axis xyz="0 0 1"/><limit lower="0" upper="0"/>'),
)


def states(*positions: float, names: str = "yaw") -> JointState:
    return JointState(Header(0, ""), tuple(names.split()), np.array(positions))


def numbers(chance: np.random.Generator, scale: float = 1.0) -> str:
    return " ".join(map(repr, (chance.normal(size=3) * scale).tolist()))


def any_robot(chance: np.random.Generator, count: int) -> str:
    """A tree of links with joints of all kinds, three of which mimic others, one of them a mimic joint."""
    kinds = ["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
    joints = []
    for number in range(count):
        kind = kinds[number] if number < len(kinds) else kinds[chance.integers(4)]
        parent = "world" if not number else f"l{chance.integers(max(0, number - 3), number)}"
        more = f'<origin xyz="{numbers(chance, 0.1)}" rpy="{numbers(chance, 2)}"/><axis xyz="{numbers(chance)}"/>'
        if number in (9, 10, 11):
            kind, driver = "revolute", {9: "j0", 10: "j9", 11: "j2"}[number]
            more += f'<mimic joint="{driver}" multiplier="{-1.5 * number / 10}" offset="0.{number}"/>'
        joints.append(joint(f"j{number}", parent, f"l{number}", kind, more))
    chance.shuffle(joints)
    return urdf(*joints, links=" ".join(["world", *(f"l{number}" for number in range(count))]))


def kinematics(text: str, positions: dict[str, float]) -> dict[str, Array]:
    """Link → pose (4, 4) in the root, from matrices, and as simply as possible."""

    def vector(element: Any, key: str, default: str) -> Array:
        return np.array((element.get(key, default) if element is not None else default).split(), float)

    def turn(axis: Array, angle: float) -> Array:
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
        return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)

    joints = {each.get("name"): each for each in ElementTree.fromstring(text).iter("joint")}

    def position(name: str) -> float:
        mimic = joints[name].find("mimic")
        if mimic is None or name in positions:
            return positions.get(name, 0.0)
        return float(mimic.get("multiplier", 1)) * position(str(mimic.get("joint"))) + float(mimic.get("offset", 0))

    def place(link: str) -> Array:
        for name, each in joints.items():
            if each.find("child").get("link") == link:  # type: ignore[union-attr]
                origin = each.find("origin")
                roll, pitch, yaw = vector(origin, "rpy", "0 0 0")
                x, y, z = np.eye(3)
                fixed, moved = np.eye(4), np.eye(4)
                fixed[:3, :3], fixed[:3, 3] = (
                    turn(z, yaw) @ turn(y, pitch) @ turn(x, roll),
                    vector(origin, "xyz", "0 0 0"),
                )
                axis = vector(each.find("axis"), "xyz", "1 0 0")
                if each.get("type") in ("revolute", "continuous"):
                    moved[:3, :3] = turn(axis, position(str(name)))
                elif each.get("type") == "prismatic":
                    moved[:3, 3] = axis / np.linalg.norm(axis) * position(str(name))
                return np.asarray(place(str(each.find("parent").get("link"))) @ fixed @ moved)  # type: ignore[union-attr]
        return np.eye(4)

    return {str(each.find("child").get("link")): place(str(each.find("child").get("link"))) for each in joints.values()}  # type: ignore[union-attr]


def drawn_poses(drawn: Drawn, entry: int, root: str = "world") -> dict[str, Array]:
    """Link → pose (4, 4) in the root, as the rows of the recording have it after an entry."""
    steps = {}
    for path in [path for path in drawn.batches if path.startswith("frames/")]:
        row = [row for row in drawn.rows(path) if row["entry"] <= entry][-1]
        ((x, y, z, w),) = row["Transform3D:quaternion"]
        step = np.eye(4)
        step[:3, :3] = [
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ]
        step[:3, 3] = row["Transform3D:translation"][0]
        steps[row["Transform3D:child_frame"][0]] = (row["Transform3D:parent_frame"][0], step)

    def place(frame: str) -> Array:
        return np.eye(4) if frame == root else np.asarray(place(steps[frame][0]) @ steps[frame][1])

    return {frame: place(frame) for frame in steps}


def assert_same(drawn: Drawn, entry: int, expected: dict[str, Array]) -> None:
    found = drawn_poses(drawn, entry)
    assert found.keys() == expected.keys()
    for link, pose in expected.items():
        np.testing.assert_allclose(found[link], pose, atol=1e-6, err_msg=link)


@pytest.mark.parametrize("seed", range(3))
def test_links_are_where_independent_kinematics_puts_them(draw: Draw, seed: int) -> None:
    chance = np.random.default_rng(seed)
    text = any_robot(chance, 14)
    names = [f"j{number}" for number in range(14) if number not in (9, 10) or seed == 2]
    chance.shuffle(names)
    moves = chance.uniform(-3, 3, (5, len(names)))
    drawn = draw(
        ("/robot_description", String(text)),
        *(("/joint_states", states(*row, names=" ".join(names))) for row in moves),
    )
    assert_same(drawn, 1, kinematics(text, {}))
    still = [f"j{number}" for number in (3, 4, 5)]
    for number, row in enumerate(moves.tolist()):
        assert_same(drawn, number + 2, kinematics(text, dict(zip(names, row, strict=True)) | dict.fromkeys(still, 0.0)))
    assert drawn.view.counts.refused == {}
    (shown,) = drawn.view.seen.of(EntityKind.ROBOT)
    assert len(shown.links) == 15
    assert blueprints.choose(drawn.view.seen) == "navigation"
    blueprints.blueprint("navigation", drawn.view.seen)


def moving(name: str, parent: str, child: str, place: str, turn: str, more: str = "", kind: str = "revolute") -> str:
    """A joint about or along z."""
    limit = '<limit effort="1000" lower="-0.78371" upper="1.157657" velocity="10"/>' if kind != "continuous" else ""
    origin = f'<origin rpy="{turn}" xyz="{place}"/><axis xyz="0.0 0.0 1"/>'
    return joint(name, parent, child, kind, origin + limit + more)


def surgical_arm(*, bars: str, jaws: bool, alias: bool) -> str:
    """An arm like those of a dVRK: a parallelogram holds a remote centre of motion, its bars mimic the pitch.

    Args:
        bars: type of the joints of the bars, ``revolute`` or ``continuous``.
        jaws: a wrist, and two jaws that mimic half of a third one; else an endoscope.
        alias: a second name of the remote centre, by a fixed joint from the base.
    """
    same, other = (f'<mimic joint="pitch" multiplier="{sign}"/>' for sign in ("1", "-1"))
    joints = [
        joint("rcm_fixed", "world", "rcm", "fixed", '<origin rpy="0.0 0.0 0.0" xyz="0.0 0.0 0.0"/>'),
        joint("base_fixed", "rcm", "base", "fixed", '<origin xyz="-0.612599207482277 0.0 -0.10146"/>'),
        moving("yaw", "base", "yaw_link", "0.0732 0.0 0.10146", "1.5707963267948966 0.0 1.5707963267948966"),
        moving("pitch", "yaw_link", "bar1", "0.0 0.0 0.199", "3.141592653589793 -1.5707963267948966 0.0"),
        moving("pitch_2", "bar1", "bar2", "-0.103 -0.2868 0.0", "0.0 0.0 0.0", other, bars),
        moving("pitch_3", "bar2", "bar3", "0.3404 -0.000136 0.0", "0 0 0", same, bars),
        moving("pitch_4", "bar2", "bar4", "0.1 0.0 0.0", "0 0 0.2", same, bars),
        moving("pitch_5", "bar1", "bar5", "-0.05 -0.14 0.0", "0 0 -0.1", other, bars),
        moving("insertion", "bar3", "carriage", "0.042 -0.086 0", "1.5707963267948966 -0.3 0", kind="prismatic"),
        moving("roll", "carriage", "shaft", "0 0 0.4162", "0 0 3.1"),
    ]
    if jaws:
        half, less = (f'<mimic joint="jaw" multiplier="{sign}"/>' for sign in ("0.5", "-0.5"))
        joints += [
            moving("wrist_pitch", "shaft", "wrist", "0 0 0.0091", "-1.5707963267948966 -1.5707963267948966 0"),
            moving("wrist_yaw", "wrist", "grip", "0.0091 0 0", "-1.5707963267948966 -1.5707963267948966 0"),
            joint("tool_tip", "grip", "tip", "fixed", '<origin rpy="0 -1.57 0" xyz="0 0 0.0102"/>'),
            moving("jaw", "grip", "jaw_link", "0 0 0", "0 0 0"),
            moving("jaw_1", "grip", "left", "0 0 0", "0 0 0", half),
            moving("jaw_2", "grip", "right", "0 0 0", "0 0 0", less),
        ]
    else:
        joints.append(joint("endoscope", "shaft", "tip", "fixed", '<origin rpy="0 0 0.5" xyz="0 0 0.38"/>'))
    if alias:
        joints.append(
            joint("remote_center_alias", "base", "remote_center", "fixed", '<origin xyz="0.6126 0 0.10146"/>')
        )
    links = " ".join(re.findall(r'child link="(\w+)"', "".join(joints)))
    bodies = f'{BALL}<visual><origin xyz="0.1 0 0" rpy="0 1.5 0"/><geometry><cylinder radius="0.004" length="0.3"/>'
    return urdf(*joints, links=f"world {links}", body=f"{bodies}</geometry></visual>", name="PSM1")


@pytest.mark.parametrize(
    ("bars", "jaws", "alias"), [("revolute", True, False), ("continuous", True, True), ("revolute", False, True)]
)
def test_surgical_arms_move_as_rerun_moves_them(draw: Draw, tmp_path: Path, bars: str, jaws: bool, alias: bool) -> None:
    from rerun.urdf import UrdfTree

    path = tmp_path / "arm.urdf"
    path.write_text(surgical_arm(bars=bars, jaws=jaws, alias=alias))
    tree = UrdfTree.from_file_path(path)
    free = [each for each in tree.joints() if each.mimic is None and each.joint_type != "fixed"]
    assert len(free) == 4 + 3 * jaws
    chance = np.random.default_rng(1)
    positions = {each.name: float(chance.uniform(each.limit_lower, each.limit_upper)) for each in free}
    message = states(*positions.values(), names=" ".join(positions))
    drawn = draw(("/PSM1/robot_description", String(path.read_text())), ("/PSM1/measured_js", message))
    assert_same(drawn, 2, kinematics(path.read_text(), positions))
    for each in free:
        (row,) = (row for row in drawn.rows(f"frames/{each.child_link}") if row["entry"] == 2)
        expected = each.compute_transform(positions[each.name], clamp=False)
        np.testing.assert_allclose(
            row["Transform3D:translation"], expected.translation.as_arrow_array().to_pylist(), atol=1e-6
        )


def test_two_arms_with_one_urdf_get_different_frames_and_their_own_joint_states(draw: Draw) -> None:
    drawn = draw(
        ("/PSM1/robot_description", String(ARM)),
        ("/PSM2/robot_description", String(ARM)),
        ("/PSM1/robot_description", String(ARM)),  # latched, for a late joiner
        ("/PSM1/measured_js", states(1.0)),
        ("/igtl/PSM2/jaw/measured_js", states(2.0)),
        ("/joint_states", states(3.0)),
    )
    assert set(drawn_poses(drawn, 6)) == {"a", "b", "PSM2/a", "PSM2/b"}
    angle = {frame: math.atan2(pose[1, 0], pose[0, 0]) for frame, pose in drawn_poses(drawn, 6).items()}
    assert (angle["b"], angle["PSM2/b"]) == pytest.approx((1.0, 2.0), abs=1e-6)
    assert sum("2 robots have it" in line for line in drawn.log()) == 1
    assert len(drawn.view.seen.trees()) == 1  # both stand in the world


def test_wanted_positions_other_names_and_second_sources_move_nothing(draw: Draw) -> None:
    drawn = draw(
        ("/robot_description", String(ARM)),
        *(("/setpoint_js", states(1.0)) for _ in range(3)),
        *(("/gripper", states(1.0, 2.0, names="jaw other")) for _ in range(3)),
        ("/measured_js", states(0.5)),
        ("/other", states(1.0)),
        ("/unnamed", JointState(Header(0, ""), (), np.array([1.0]))),
        ("/measured_js", states(math.nan)),
        ("/measured_js", states()),
        ("/measured_js", states(1e300)),
    )
    rows = [row for row in drawn.rows("frames/b") if row["entry"] > 1]
    assert [row["entry"] for row in rows] == [8]
    text = "\n".join(drawn.log())
    for line in ("commands and goals", "no robot has: jaw, other", "yaw: /measured_js moves it", "without names"):
        assert text.count(line) == 1
    assert text.count("found nan, expected a position") == 1
    assert drawn.view.counts.refused == {}


def edge(child: str, parent: str, x: float) -> TFMessage:
    return TFMessage((FrameTransform(Header(0, parent), child, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),))


@pytest.mark.parametrize("is_first", [True, False])
def test_tf_takes_precedence_and_there_is_one_robot(draw: Draw, is_first: bool) -> None:
    tf = [("/tf_static", edge("a", "world", 0.5)), ("/tf", edge("b", "a", 0.25))]
    robot = ("/robot_description", String(ARM))
    before, after = (tf, [robot]) if is_first else ([robot], tf)
    drawn = draw(*before, *after, ("/joint_states", states(1.0)), *tf, ("/joint_states", states(1.0)))
    frames = {path for path in (*drawn.batches, *drawn.static_batches) if path.startswith("frames/")}
    assert frames == {"frames/a", "frames/b"}
    last = drawn.rows("frames/b")[-1]
    assert (last["entry"], last["Transform3D:translation"]) == (6, [[0.25, 0, 0]])
    # one static entity at most for each frame: the viewer rejects two
    static = [path for path in ("frames/a", "places/frames/a/frame") if "Transform3D:translation" in drawn.static(path)]
    assert len(static) == 1
    said = [line for line in drawn.log() if "joint states do not move them" in line]
    assert len(said) == (0 if is_first else 2)
    assert drawn.count("robot_description/b/1") == 1


def test_bodies_lines_and_missing_meshes(draw: Draw) -> None:
    mesh = '<visual><geometry><mesh filename="package://none/a.stl"/></geometry></visual>'
    slide = joint(
        "slide", "a", "b", "prismatic", '<origin xyz="0 1 0"/><axis xyz="0 0 2"/><limit lower="-1" upper="2"/>'
    )
    text = urdf(joint("base", "world", "a", "fixed", '<origin xyz="0 0 1"/>'), slide, body=mesh)
    drawn = draw(("/robot_description", String(text)), ("/joint_states", states(0.5, names="slide")))
    ((line, rail),) = (row["LineStrips3D:strips"] for row in drawn.rows("robot_description/a/lines"))
    assert (line, rail) == ([[0, 0, 0], [0, 1, 0]], [[0, 1, -1], [0, 1, 2]])
    assert [line for line in drawn.log() if "missing" in line] == [
        "/robot_description: 3 of 3 meshes are missing: none: not found in AMENT_PREFIX_PATH or ROS_PACKAGE_PATH"
    ]
    axes = drawn.rows("frames/b")[-1]
    assert axes["TransformAxes3D:axis_length"] == [pytest.approx(0.02)]
    assert axes["TransformAxes3D:show_frame"] == [False]


def test_the_robot_of_a_file_is_there_at_all_times(tmp_path: Path, draw: Draw) -> None:
    from igtl_gateway.addons.view import stream
    from igtl_gateway.addons.view.session import SessionView

    from .conftest import messages, read_back

    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "a.stl").write_bytes(STL)
    file = tmp_path / "arm.urdf"
    file.write_text(ARM.replace(BALL, '<visual><geometry><mesh filename="meshes/a.stl"/></geometry></visual>'))
    recording = stream.to_file(tmp_path / "out.rrd", "test")
    view = SessionView(recording)
    view.add_robot(file, "/PSM1")
    for entry in messages(("/PSM1/robot_description", String(ARM)), ("/PSM1/measured_js", states(1.0))):
        view.take(entry)
    view.finish()
    stream.close(recording)
    drawn = read_back(tmp_path / "out.rrd", view)
    assert bytes(drawn.static("robots/PSM1/arm/b/1")["Asset3D:blob"][0]) == STL
    assert drawn.rows("frames/b")[-1]["entry"] == 2
    assert sum("not drawn" in line for line in drawn.log()) == 1
    with pytest.raises(UnsupportedRecording):
        SessionView(recording).add_robot(tmp_path / "none.urdf")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "invalid XML"),
        ("<a/>", "found <a>, expected <robot>"),
        ("<robot/>", "found no link"),
        (urdf(links="a a"), "two links named 'a'"),
        (urdf(links="a b"), "2 links without a parent"),
        (urdf(joint("j", "a", "b"), joint("k", "b", "a"), links="a b"), "ring of links"),
        (urdf(joint("j", "a", "b"), joint("k", "b", "a"), links="a b c"), "ring of links"),
        (urdf(joint("j", "a", "b"), joint("k", "a", "b"), links="a b"), "two parents of link 'b'"),
        (urdf(joint("j", "a", "b"), joint("j", "a", "c"), links="a b c"), "two joints with one name"),
        (urdf(joint("j", "a", "x"), links="a b"), "child 'x'"),
        (urdf(joint("j", "a", "b", "screw"), links="a b"), "type 'screw'"),
        (urdf(joint("j", "a", "b", more='<origin xyz="0 nan 0"/>'), links="a b"), "xyz='0 nan 0', expected 3 finite"),
        (urdf(joint("j", "a", "b", more='<origin xyz="${x} 0 0"/>'), links="a b"), "3 finite numbers"),
        (urdf(joint("j", "a", "b", more='<origin xyz="1e300 0 0"/>'), links="a b"), "3 finite numbers"),
        (urdf(joint("j", "a", "b", more='<axis xyz="0 0 0"/>'), links="a b"), "axis 0 0 0"),
        (urdf(joint("j", "a", "b", more='<mimic joint="x"/>'), links="a b"), "no joint that it mimics"),
        (urdf(joint("j", "a", "b", more='<mimic joint="j"/>'), links="a b"), "ring of mimic joints"),
        ('<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot/>', "document type"),
    ],
)
def test_what_is_no_robot_is_refused_with_its_place(draw: Draw, text: str, found: str) -> None:
    drawn = draw(("/robot_description", String(text)), ("/joint_states", states(1.0)))
    assert drawn.view.counts.refused == {"/robot_description": 1}
    (line,) = (line for line in drawn.log() if "cannot be drawn" in line)
    assert "/robot_description: " in line
    assert found in line
    assert drawn.count("robot_description") == 1


def test_the_size_of_a_robot_is_bounded() -> None:
    with pytest.raises(LimitExceeded, match="1,001 links, expected at most 1,000"):
        parse_urdf(urdf(links=" ".join(f"l{number}" for number in range(1001)), body=""), "x")
    with pytest.raises(LimitExceeded, match="3,000 bodies"):
        parse_urdf(urdf(links="a", body=BALL * 3000), "x")
    deep = urdf(
        *(joint(f"j{n}", f"l{n}", f"l{n + 1}") for n in range(999)), links=" ".join(f"l{n}" for n in range(1000))
    )
    assert len(parse_urdf(deep, "x").joints) == 999


def test_meshes_are_found_in_packages_only(tmp_path: Path) -> None:
    share, source, home = tmp_path / "share" / "arm", tmp_path / "src" / "tool", tmp_path / "home"
    for folder in (share / "meshes", source, home / "urdf", home / "meshes"):
        folder.mkdir(parents=True)
    secret = tmp_path / "secret.stl"
    for path in (
        share / "meshes" / "a.stl",
        source / "b.STL",
        home / "meshes" / "c.stl",
        home / "urdf" / "d.stl",
        secret,
    ):
        path.write_bytes(STL)
    (home / "urdf" / "link.stl").symlink_to(secret)
    folders = MeshFolders({"AMENT_PREFIX_PATH": str(tmp_path), "ROS_PACKAGE_PATH": f"{tmp_path / 'src'}:"})
    file = home / "urdf" / "arm.urdf"
    assert folders.find("package://arm/meshes/a.stl").data == STL
    assert folders.find("package://tool/b.STL").media_type == "model/stl"
    assert folders.find("d.stl", file).data == folders.find(f"file://{file.parent}/d.stl", file).data == STL
    for uri in (
        f"file://{secret}", str(secret), "meshes/a.stl", "d.stl", "", "package://", "package://arm", "package://arm/../secret.stl",
        "package://../secret.stl", "package://arm//etc/passwd", "package://arm/meshes", "http://x/a.stl", "package://arm/\0.stl",
        "package://arm/meshes/none.stl",
    ):  # fmt: skip
        with pytest.raises(UnsupportedRecording):
            folders.find(uri)
    for uri in ("../meshes/c.stl", str(secret), f"file://{secret}", "link.stl", "../../secret.stl", "/dev/zero"):
        with pytest.raises(UnsupportedRecording):
            folders.find(uri, file)
    (home / "package.xml").write_text("<package><name>my_arm</name></package>")
    assert folders.find("../meshes/c.stl", file).data == folders.find("package://my_arm/meshes/c.stl", file).data == STL
    with pytest.raises(UnsupportedRecording, match="outside of"):
        folders.find("../../secret.stl", file)


@pytest.mark.parametrize(
    ("name", "data", "found"),
    [
        ("a.stl", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n", "pointer of Git LFS"),
        ("a.stl", STL + b"x", "other content"),
        ("a.dae", b'<!DOCTYPE a [<!ENTITY b "x">]><COLLADA/>', "other content"),
        ("a.glb", b"", "other content"),
        ("a.gltf", b"{}", "found '.gltf'"),
    ],
)
def test_a_mesh_is_what_its_name_states(tmp_path: Path, name: str, data: bytes, found: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UnsupportedRecording, match=found):
        MeshFolders({}).find(name, tmp_path / "x.urdf")


def test_a_mesh_is_bounded(tmp_path: Path) -> None:
    with (tmp_path / "a.stl").open("wb") as stream:
        stream.truncate(40 << 20)
    with pytest.raises(UnsupportedRecording, match="found 41,943,040 bytes"):
        MeshFolders({}).find("a.stl", tmp_path / "x.urdf")


def test_errors_of_a_urdf_are_one_line() -> None:
    with pytest.raises(DamagedRecording) as caught:
        parse_urdf(f'<robot><link name="{"x" * 100_000}"/><link name="y"/><joint name="{"j" * 10_000}"/></robot>', "x")
    assert len(str(caught.value)) < 200
