"""The table of the rules: where identity is in a session, what happens to it, and the option of DICOM PS3.15.

Each change is counted by the name of its rule.  docs/how-to/deidentify.md has the table.
"""

from __future__ import annotations

from dataclasses import dataclass

from igtl_gateway.addon import StrEnum


class Action(StrEnum):
    """What happens, in the words of DICOM PS3.15 E.1; the letter of the standard is the value."""

    REMOVE = "X"
    EMPTY = "Z"
    CLEAN = "C"
    KEEP = "K"
    PSEUDONYM = "U"


#: Options of DICOM PS3.15 (context group 7050): code → meaning.
OPTIONS = {
    "113100": "Basic Application Confidentiality Profile",
    "113101": "Clean Pixel Data Option",
    "113102": "Clean Recognizable Visual Features Option",
    "113104": "Clean Structured Content Option",
    "113105": "Clean Descriptors Option",
    "113106": "Retain Longitudinal Temporal Information Full Dates Option",
    "113107": "Retain Longitudinal Temporal Information Modified Dates Option",
    "113111": "Retain Safe Private Option",
}


@dataclass(frozen=True, slots=True)
class Rule:
    """One row.

    Attributes:
        name: name in the report.
        place: where in the session.
        what: what happens.
        action: its code in DICOM PS3.15.
        option: the option of DICOM PS3.15 that asks for it.
    """

    name: str
    place: str
    what: str
    action: Action
    option: str


RULES = {
    rule.name: rule
    for rule in (
        Rule("patient", "IMGMETA, VIDEOMETA: patient_name and patient_id; the same fields of igtl_msgs",
             "name empty, identifier replaced by a pseudonym", Action.PSEUDONYM, "113100"),
        Rule("name", "device names, frames, topics, names of tools, points, labels, joints, owners; marks",
             "pseudonym, or the name in the profile", Action.PSEUDONYM, "113105"),
        Rule("text", "STRING, STATUS, COMMAND, CLIENTINFO, groups, marks, all other strings of ROS messages",
             "removed; a rule of the profile keeps, replaces or cleans it", Action.EMPTY, "113104"),
        Rule("metadata", "keys and values of header version 2, MetadataItem of igtl_msgs",
             "removed, unless the profile keeps the key; the gateway's own keys are cleaned", Action.REMOVE, "113104"),
        Rule("padding", "bytes behind the end of strings, extensions of the extended header, reserved bytes",
             "zero or removed", Action.REMOVE, "113100"),
        Rule("type", "messages of types without a known layout, and RawMessage",
             "removed, unless the profile keeps the type", Action.REMOVE, "113100"),
        Rule("kept type", "messages of such types that the profile keeps",
             "kept as they are, stamps and strings included, if they have no readable definition",
             Action.KEEP, "113111"),
        Rule("bytes", "arrays of 8-bit numbers that are not pictures or clouds",
             "the message is removed, because they may be text", Action.REMOVE, "113100"),
        Rule("place", "positions on the earth: NavSatFix", "removed", Action.REMOVE, "113100"),
        Rule("damaged", "messages that cannot be decoded, and messages with a wrong checksum",
             "removed", Action.REMOVE, "113100"),
        Rule("pixels", "streams with a mask: IMAGE, VIDEO, Image, CompressedImage, Volume",
             "masked; encoded pictures are encoded again, or removed if that fails", Action.CLEAN, "113101"),
        Rule("picture data", "EXIF, comments and text of JPEG and PNG;"
             " in H.264, H.265 and AV1 all units that no decoder needs",
             "removed", Action.REMOVE, "113101"),
        Rule("address", "peers and ports of links, in notes and in [[peers]]", "pseudonym", Action.PSEUDONYM, "113100"),
        Rule("note", "text and facts of notes; numbers that the gateway needs stay",
             "removed", Action.REMOVE, "113104"),
        Rule("setting", "names in the configuration", "pseudonym, as above; metadata removed",
             Action.PSEUDONYM, "113105"),
        Rule("session", "host, platform, command, custom data, file names and all other metadata of the recording",
             "removed", Action.REMOVE, "113100"),
        Rule("time", "stamps of the gateway, of senders, in headers and in messages; times of scans",
             "moved by one constant; --keep-times keeps them (113106)", Action.CLEAN, "113107"),
    )
}  # fmt: skip

#: What no rule looks at: in each report.
NOT_COVERED = (
    "heads and faces in volumes, surfaces, point clouds and pictures (113102 is not claimed)",
    "text that is burnt into pictures, outside of the masks of the profile",
    "numbers: poses, forces, arrays of 16 bits and more, colour tables, identifiers that are numbers",
    "how a person moves, and what is rare about an intervention",
)
