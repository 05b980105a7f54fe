"""The fates of a received message: the one list of the words that the loss ledger counts, with their meaning."""

from __future__ import annotations

CONVERTED, UNSUBSCRIBED, RECORDED_ONLY = "converted", "unheard", "recorded_only"
PROBED, RELAYED, MARKED, GREETED, ASKED = "probed", "relayed", "marked", "greeted", "asked"

#: Fate of a message that was not dropped → its text for people.  Every other word is the reason of a loss.
KEPT = {
    CONVERTED: "converted for the other side",
    UNSUBSCRIBED: "not converted: no subscriber in ROS, and no recording",
    RECORDED_ONLY: "of a topic that is recorded and not bridged",
    PROBED: "the test message of `igtl-gateway doctor`",
    RELAYED: "forwarded by a relay",
    GREETED: "the greeting of 3D Slicer, a STATUS without a state",
    ASKED: "a question for the clock, or the answer to one",
    MARKED: "a COMMAND Mark, which the gateway answered",
}

#: Reason why a message was dropped → its text for people, besides ``REFUSED_COMMANDS`` and NOT_FOR.
DROPPED = {
    "no_peer": "no peer was connected",
    "not_wanted": "no connected peer takes it: type, pace or frame",
    "not_for_peer": "the profile of every peer excludes this type",
    "not_chosen": "the configuration publishes no topic of it",
    "part_of_volume": "part of a volume that was not complete yet",
    "no_base": "part of an image that is not kept (keep_mib)",
    "no_conversion": "no conversion to ROS",
    "empty": "empty body, not published",
    "too_many_streams": "more streams than allowed",
    "conversion": "could not be converted",
    "denied": "denied by the configuration",
    "inactive": "the gateway was not active",
    "not_finite": "NaN or infinity",
    "not_valid": "marked as not valid by the robot",
    "stale": "older than max_age_s",
    "truncated": "shorter than its fields declare",
    "bad_crc": "wrong CRC",
    "malformed": "not allowed by the format",
    "too_large": "above the size limit",
    "wire_error": "invalid OpenIGTLink",
    "internal_error": "dropped by a defect of the gateway",
    "command_refused": "a command that cannot be passed on",
    "mark_refused": "a COMMAND Mark that cannot be a mark",
    "no_partner": "the other side of the relay was disconnected",
    "fault_loss": "lost by fault injection",
    "fault_disconnect": "its link was closed by fault injection",
    "link_down": "its link was closed while fault injection delayed it",
    "queue": "the send queue of the peer was full",
    "link_closed": "the link was closing",
}

#: Key in the data of the note about a refused command: its device, which need not be that of the message, as in a BIND.
REFUSED_DEVICE = "device"

#: Codes of the notes about refused commands, and what they mean; also the fates of the messages.
REFUSED_COMMANDS = {
    "command_not_allowed": "no allow_in has the device",
    "command_type": "the OpenIGTLink type is not that of the CRTK name",
    "command_unstamped": "the command has no stamp, so its age is not known",
    "command_old": "the stamp is older than max_age_s",
    "command_early": "the stamp is more than max_age_s in the future",
    "command_backwards": "the stamp is not after that of the last accepted command",
    "command_not_finite": "a number is NaN or infinite",
    "command_not_rigid": "the matrix is not a rotation",
    "command_frame": "the pose is in another frame",
    "command_unknown_state": "the state of the arm that a limit needs is not known",
    "command_workspace": "the pose is outside the workspace",
    "command_speed": "the tool or its rotation would be too fast",
    "command_joint_count": "the number of joints is not that of the arm",
    "command_joint_range": "a joint is outside its range",
    "command_joint_speed": "a joint would be too fast",
    "command_force": "force or torque is too large",
    "command_word": "the word is not one of state_command",
    "command_behind": "the arm is too far behind the stream of set points",
    "command_unheard": "no robot subscribes to the topic",
    "command_newcomer": "a subscriber has joined: the stream begins again where the arm is",
    "command_late": "the command was older than max_age_s when it was to be written",
    "command_failed": "the middleware refused it",
}

#: Reason of an output that a peer does not get: this, and the name of its profile.
NOT_FOR = "not_for_"
