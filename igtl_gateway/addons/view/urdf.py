"""Reads a URDF.  Inertia, collision bodies, transmissions and most limits are not read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from igtl_gateway.addon import DamagedRecording
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import Element, limits, parse_xml
from igtl_gateway.addons.view.robot_model import (
    MOVING,
    Joint,
    JointKind,
    Quaternion,
    Robot,
    Visual,
    Xyz,
    multiply,
    scaled,
)

#: Links, and bodies of links, of one robot; a humanoid with hands has about 100.
MAX_LINKS, MAX_VISUALS = 1000, 2000
#: Larger numbers, in metres or radians, are errors.
_HUGE = 1e9

_X, _ZERO, _ONE = (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
_GREY = (0.7, 0.7, 0.72, 1.0)


def parse_urdf(data: str | bytes, place: str) -> Robot:
    """Return the robot of a URDF.

    Raises DamagedRecording for an invalid URDF or links that are not a tree, LimitExceeded above the limits.
    """
    root = parse_xml(data, place)
    if root.name != "robot":
        raise DamagedRecording(f"{place}: line {root.line}: found <{root.name[:40]}>, expected <robot>")
    links = root.all("link")
    if len(links) > MAX_LINKS:
        raise limits.exceeded("document", count_text(len(links), "link"), place, f"{MAX_LINKS:,}")
    names = [_named(link, place) for link in links]
    if not names or len(set(names)) != len(names):
        twice = next((name for name in names if names.count(name) > 1), "")
        found = f"two links named {twice!r}" if twice else "no link"
        raise DamagedRecording(f"{place}: found {found}, expected one or more, each with its own name")
    joints = [_joint(joint, set(names), place) for joint in root.all("joint")]
    if len({joint.name for joint in joints}) != len(joints):
        raise DamagedRecording(f"{place}: found two joints with one name, expected different names")
    base, ordered = _tree(names, joints, place)
    materials = {
        material.attributes.get("name", ""): colour
        for material in root.all("material")
        if (colour := _colour(material, place)) is not None
    }
    visuals = {
        name: bodies
        for name, link in zip(names, links, strict=True)
        if (bodies := tuple(_visuals(link, materials, place)))
    }
    if (bodies_found := sum(map(len, visuals.values()))) > MAX_VISUALS:
        raise limits.exceeded("document", count_text(bodies_found, "body", "bodies"), place, f"{MAX_VISUALS:,}")
    name = root.attributes.get("name", "") or base
    return Robot(name, base, tuple(_driven(joint, joints, place) for joint in ordered), visuals)


def _tree(names: Sequence[str], joints: Sequence[Joint], place: str) -> tuple[str, list[Joint]]:
    """Return the root link, and the joints with parents before children."""
    below: dict[str, list[Joint]] = {}
    children: set[str] = set()
    for joint in joints:
        if joint.child in children:
            raise DamagedRecording(f"{place}: found two parents of link {joint.child!r}, expected one")
        children.add(joint.child)
        below.setdefault(joint.parent, []).append(joint)
    roots = [name for name in names if name not in children]
    if len(roots) != 1:
        found = f"{counted(len(roots), 'link')} without a parent" if roots else "a ring of links"
        raise DamagedRecording(f"{place}: found {found}, expected one tree")
    ordered: list[Joint] = []
    waiting = [roots[0]]
    while waiting:
        found_below = below.get(waiting.pop(0), [])
        ordered += found_below
        waiting += [joint.child for joint in found_below]
    if len(ordered) != len(joints):
        raise DamagedRecording(f"{place}: found a ring of links, expected one tree")
    return roots[0], ordered


def _joint(element: Element, links: set[str], place: str) -> Joint:
    name = _named(element, place)
    at = f"{place}: line {element.line}: joint {name[:40]!r}"
    kind = element.attributes.get("type", "")
    if kind not in list(JointKind):
        raise DamagedRecording(f"{at}: found the type {kind[:40]!r}, expected one of {', '.join(JointKind)}")
    ends = []
    for end in ("parent", "child"):
        found = element.first(end)
        link = found.attributes.get("link", "") if found else ""
        if link not in links:
            raise DamagedRecording(f"{at}: found the {end} {link[:40]!r}, expected a link of the robot")
        ends.append(link)
    xyz, quaternion = _origin(element, at)
    axis = _numbers(element.first("axis"), "xyz", _X, at)
    length = math.hypot(*axis)
    if JointKind(kind) in MOVING and not length:
        raise DamagedRecording(f"{at}: found the axis 0 0 0, expected a direction")
    mimic, limit = element.first("mimic"), element.first("limit")
    return Joint(
        name,
        JointKind(kind),
        ends[0],
        ends[1],
        xyz,
        quaternion,
        scaled(axis, 1 / (length or 1.0)),
        mimic.attributes.get("joint", "") if mimic else "",
        _number(mimic, "multiplier", 1.0, at),
        _number(mimic, "offset", 0.0, at),
        (_number(limit, "lower", 0.0, at), _number(limit, "upper", 0.0, at)) if kind == JointKind.PRISMATIC else (0, 0),
    )


def _driven(joint: Joint, joints: Sequence[Joint], place: str) -> Joint:
    """Return the joint with the driver that itself mimics no other joint."""
    if not joint.driver:
        return joint
    by_name = {each.name: each for each in joints}
    multiplier, offset, driver = joint.multiplier, joint.offset, by_name.get(joint.driver)
    for _ in joints:
        if driver is None:
            raise DamagedRecording(f"{place}: joint {joint.name[:40]!r}: found no joint that it mimics, expected one")
        if not driver.driver:
            return replace(joint, driver=driver.name, multiplier=multiplier, offset=offset)
        offset += multiplier * driver.offset
        multiplier *= driver.multiplier
        driver = by_name.get(driver.driver)
    raise DamagedRecording(f"{place}: joint {joint.name[:40]!r}: found a ring of mimic joints, expected a driver")


def _visuals(link: Element, materials: dict[str, tuple[float, float, float, float]], place: str) -> list[Visual]:
    """Return the bodies of a link; a geometry that is not one of the four shapes is left out."""
    found = []
    for visual in link.all("visual"):
        at = f"{place}: line {visual.line}: link {link.attributes['name'][:40]!r}"
        xyz, quaternion = _origin(visual, at)
        material = visual.first("material")
        colour = _colour(material, place) if material else None
        if material and colour is None:
            colour = materials.get(material.attributes.get("name", ""))
        geometry = visual.first("geometry")
        for shape in geometry.children if geometry else ():
            match shape.name:
                case "box":
                    size: tuple[float, ...] = _numbers(shape, "size", _ZERO, at)
                case "sphere":
                    size = (_number(shape, "radius", 0.0, at),)
                case "cylinder":
                    size = (_number(shape, "radius", 0.0, at), _number(shape, "length", 0.0, at))
                case "mesh":
                    size = _numbers(shape, "scale", _ONE, at)
                case _:
                    continue
            found.append(Visual(shape.name, size, xyz, quaternion, colour, shape.attributes.get("filename", "")))
    return found


def _origin(element: Element, at: str) -> tuple[Xyz, Quaternion]:
    origin = element.first("origin")
    roll, pitch, yaw = (angle / 2 for angle in _numbers(origin, "rpy", _ZERO, at))
    about_x = (math.sin(roll), 0.0, 0.0, math.cos(roll))
    about_y = (0.0, math.sin(pitch), 0.0, math.cos(pitch))
    about_z = (0.0, 0.0, math.sin(yaw), math.cos(yaw))
    return _numbers(origin, "xyz", _ZERO, at), multiply(about_z, multiply(about_y, about_x))


def _colour(material: Element, at: str) -> tuple[float, float, float, float] | None:
    colour = material.first("color")
    if colour is None:
        return None
    red, green, blue, alpha = _parsed(colour, "rgba", _GREY, at)
    return red, green, blue, alpha


def _named(element: Element, place: str) -> str:
    name = element.attributes.get("name", "")
    if not name:
        raise DamagedRecording(f"{place}: line {element.line}: found a {element.name} without a name, expected one")
    return name


def _number(element: Element | None, key: str, default: float, at: str) -> float:
    (value,) = _parsed(element, key, (default,), at)
    return value


def _numbers(element: Element | None, key: str, default: Xyz, at: str) -> Xyz:
    x, y, z = _parsed(element, key, default, at)
    return x, y, z


def _parsed(element: Element | None, key: str, default: tuple[float, ...], at: str) -> tuple[float, ...]:
    """Return the numbers of an attribute, as many as the default has."""
    text = element.attributes.get(key) if element else None
    if text is None:
        return default
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        values = ()
    if len(values) != len(default) or not all(abs(value) < _HUGE for value in values):
        raise DamagedRecording(f"{at}: found {key}={text[:40]!r}, expected {counted(len(default), 'finite number')}")
    return values
