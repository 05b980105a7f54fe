"""Documents that people write: configurations, profiles, recipes, descriptions of robots, keys."""

from __future__ import annotations

import base64
from collections.abc import Mapping

from tools.kinds.values import Maker

Files = Mapping[str, bytes]

_CONFIG = {
    "gateway": {"base_frame": '"igtl"', "ros_unit": '"m"', "stamp": '"source"', "max_streams": "512",
                "command_timeout_s": "5.0", "deny_in": '["STRING"]', "kinds": '["pose"]', "fault_seed": "1",
                "max_age_s": "0.5", "publish_tf": "true"},
    "igtl": {"listen": '["127.0.0.1:18944"]', "max_body_mib": "64", "send_queue_mib": "8"},
    "record": {"file": '"a.mcap"', "split_mib": "5", "compression": '"lz4"', "flush_interval_s": "1.0"},
    "[to_igtl]": {"topic": '"/a"', "device": '"Chat"', "type": '"STRING"', "metadata": '{ operator = "A" }'},
    "[to_ros]": {"device": '"Probe*"', "topic": '"/p/{device}"', "frame_id": '"f"', "kinds": '["pose"]'},
    "[tf_out]": {"frames": '["Probe"]', "base": '"Tracker"', "device": '"P"'},
    "[peers]": {"at": '"127.0.0.1"', "profile": '"slicer"'},
    "[crtk]": {"arms": '"/PSM1"', "workspace": "[0, 0, 0, 1, 1, 1]", "max_speed": "0.5", "joint_min": "[0.1]",
               "joint_max": "[0.2]"},
}  # fmt: skip
_PROFILE = {
    "names": {"Probe": '"tool"'},
    "keep": {"names": '["tf"]', "types": '["X"]', "metadata": '["k"]'},
    "[mask]": {"stream": '"**"', "rectangles": "[[0, 0, 8, 8]]", "value": "0"},
    "[text]": {"stream": '"**"', "action": '"pattern"', "pattern": '"[0-9]+"', "by": '"#"'},
}
_STATE = '[[feature]]\nname = "observation.state"\nstream = "TRANSFORM/ProbeToBase"\n'
_RECIPE = {
    "dataset": {"fps": "20", "task": '"none"', "robot_type": '"none"'},
    "episodes": {"by": '"still"', "stream": '"TRANSFORM/ProbeToBase"', "pause_s": "5.0", "still_mm": "1.0"},
    "splits": {"train": '"0:1"'},
    "[feature]": {
        "name": '"action"',
        "stream": '"TRANSFORM/ProbeToBase"',
        "fields": '["position"]',
        "lag_ms": "0.5",
        "tolerance_ms": "50",
        "window": "[0, 4095]",
        "names": '["x", "y", "z"]',
    },
}


def _toml(make: Maker, tables: Mapping[str, Mapping[str, str]]) -> bytes:
    lines = []
    for name, rows in tables.items():
        bare = name.strip("[]")
        lines.append(f"[{name}]")
        lines += [f"{make.written(f'{bare}.{key}.(key)', key)} = {make.written(f'{bare}.{key}', value)}"
                  for key, value in rows.items()]  # fmt: skip
    return "\n".join([*lines, ""]).encode("utf-8", "surrogatepass")


def configuration(make: Maker) -> Files:
    names = sorted(_CONFIG)
    chosen = [make.one_of("table", names), *make.rng.sample(names, make.rng.choice((0, 1, 3)))]
    return {"a.toml": _toml(make, {f"table.{name}"[6:]: _CONFIG[name] for name in dict.fromkeys(chosen)})}


def profile(make: Maker) -> Files:
    return {"a.toml": _toml(make, _PROFILE)}


def recipe(make: Maker) -> Files:
    return {"a.toml": _toml(make, _RECIPE) + _STATE.encode()}


def robot(make: Maker) -> Files:
    """A URDF with a few links, all its numbers and names."""

    def element(tag: str, inside: str = "", **attributes: str) -> str:
        words = " ".join(f'{key}="{make.text(f"{tag}.{key}", value)}"' for key, value in attributes.items())
        return f"<{tag} {words}>{inside}</{tag}>"

    origin = element("origin", xyz="0 0 0", rpy="0 0 0")
    visual = element("visual", origin + element("geometry", element("box", size="1 1 1")))
    mesh = element("visual", element("geometry", element("mesh", filename="a.stl", scale="1 1 1")))
    links = "".join(element("link", visual + mesh, name=name) for name in ("a", "b", "c"))
    mimic = element("mimic", joint="ab", multiplier="1", offset="0")
    joints = "".join(
        element("joint", origin + element("parent", link=one) + element("child", link=two)
                + element("axis", xyz="0 0 1") + element("limit", lower="-1", upper="1", effort="1", velocity="1")
                + (mimic if one == "b" else ""), name=one + two, type="revolute")
        for one, two in ("ab", "bc")
    )  # fmt: skip
    return {"a.urdf": f'<?xml version="1.0"?>{element("robot", links + joints, name="r")}'.encode("utf-8", "replace")}


def key(make: Maker) -> Files:
    """A public key: every byte of its DER, and every line of its PEM."""
    der = bytes.fromhex("302a300506032b6570032100") + bytes(range(32))
    text = base64.b64encode(make.blob("der", make.words("der", der, 44, 1))).decode()
    lines = [make.text("begin", "-----BEGIN PUBLIC KEY-----"), make.text("base64", text),
             make.text("end", "-----END PUBLIC KEY-----"), ""]  # fmt: skip
    return {"a.pub": "\n".join(lines).encode("utf-8", "surrogatepass")}
