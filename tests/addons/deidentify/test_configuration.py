"""The rules for the configuration: each setting has one, and rows name the same streams by their new names."""

from __future__ import annotations

import dataclasses
from typing import Any

from igtl_gateway.addons.deidentify.configuration import SeenNames, clean_config
from igtl_gateway.addons.deidentify.context import Context
from igtl_gateway.addons.deidentify.profile import BASIC
from igtl_gateway.config.configuration import Config, PeerRow, TfOutRow, ToIgtlRow, ToRosRow
from igtl_gateway.convert.arms import ArmsRow
from tests.tables import table

NAME = "Qx7Kmvz3"
SEEN = SeenNames((NAME, "Probe"), (f"/{NAME}/pose", "/arm/pose"), (f"{NAME}:18944", "10.0.0.7:5"))


def context_of() -> Context:
    return Context.of(BASIC, bytes(range(32)), 0)


def new(text: str) -> str:
    return context_of().names.name(text)


def at(text: str) -> str:
    return context_of().names.address(text)


TOPIC = f"/{new(NAME)}/{new('pose')}"
ARM_TOPIC = f"/{new('arm')}/{new('pose')}"

PROBE = new("Probe")

#: Setting → given, expected.
SETTINGS: dict[str, tuple[str, Any, Any]] = {
    "base frame": ("base_frame", NAME, new(NAME)),
    "types": ("deny_in", ("IMAGE", NAME, "*"), ("IMAGE", "*")),
    "types of peers": ("deny_out", (NAME, "STRING"), ("STRING",)),
    "kinds": ("kinds", ("+pose", "transform"), ("+pose", "transform")),
    "marks": ("mark_from", (f"{NAME[:4]}*", "**"), (new(NAME), "**")),
    "robots": ("allow_in", (f"{NAME}*", "Probe"), (new(NAME), new("Probe"))),
    "robots of ROS": ("allow_out", (f"{NAME}/po*",), (TOPIC[1:],)),
    "arms": ("crtk", (ArmsRow(f"/{NAME}", frame_id=NAME),), (ArmsRow(f"/{new(NAME)}", frame_id=new(NAME)),)),
    "arms by a glob": ("crtk", (ArmsRow(f"/{NAME[:4]}*"),), (ArmsRow(f"/{new(NAME)}"),)),
    "to peers": (
        "to_igtl", (ToIgtlRow(topic=f"/{NAME}/pose", device=NAME, metadata=((NAME, NAME),)),),
        (ToIgtlRow(topic=TOPIC, device=new(NAME)),),
    ),
    "to peers, wildcards alone": ("to_igtl", (ToIgtlRow(topic="/*/pose"),), (ToIgtlRow(topic=f"/*/{new('pose')}"),)),
    "to peers, a part of a name": ("to_igtl", (ToIgtlRow(topic="/a*/pose"),), (ToIgtlRow(topic=ARM_TOPIC),)),
    "to ROS": (
        "to_ros", (ToRosRow(device=NAME, topic=f"/{NAME}/{{device}}", frame_id=NAME, child_frame_id="Probe"),),
        (ToRosRow(device=new(NAME), topic=f"/{new(NAME)}/{{device}}", frame_id=new(NAME), child_frame_id=PROBE),),
    ),
    "to ROS, types": (
        "to_ros", (ToRosRow(type="TRANS*"), ToRosRow(type=NAME), ToRosRow(type="STRING"), ToRosRow(type="?*")),
        (ToRosRow(type="TRANS*"), ToRosRow(type="-"), ToRosRow(type="STRING"), ToRosRow(type="?*")),
    ),
    "frames": (
        "tf_out", (TfOutRow(frames=(NAME, "Probe"), base="Base", device=NAME),),
        (TfOutRow(frames=(new(NAME), new("Probe")), base=new("Base"), device=new(NAME)),),
    ),
    "peers": ("peers", (PeerRow(f"{NAME}:18944", "plus"),), (PeerRow(at(f"{NAME}:18944"), "plus"),)),
    "peers by a glob": ("peers", (PeerRow(f"{NAME[:4]}*", "plus"),), (PeerRow(at(f"{NAME}:18944"), "plus"),)),
}  # fmt: skip
#: Names and items of metadata that are counted; the base frame of all rows stays.
COUNTED = {"base frame": 1, "robots": 2, "to peers": 3, "frames": 4, "to ROS": 4}
#: Settings without a name: words of a list, numbers and truth values.
STAY = frozenset(
    "ros_unit igtl_unit stamp check_crc max_streams profile publish_tf command_timeout_s relay faults fault_seed "
    "max_age_s watch cautious keep_mib latched_mib max_behind_s naming fitting reading".split()
)


@table("name", SETTINGS)
def test_each_setting_with_names_has_new_ones(name: str) -> None:
    setting, given, expected = SETTINGS[name]
    context = context_of()
    found = clean_config(dataclasses.replace(Config(), **{setting: given}), SEEN, context)
    assert getattr(found, setting) == expected
    assert NAME not in repr(found)
    assert context.report.rules["setting"] == COUNTED.get(name, context.report.rules["setting"])
    assert not context.report.rules["name"], "counted as a setting"


def test_each_setting_has_a_rule() -> None:
    tested = {setting for setting, _, _ in SETTINGS.values()}
    assert {field.name for field in dataclasses.fields(Config)} == tested | STAY
    assert not tested & STAY
