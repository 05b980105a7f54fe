"""The probe of ``doctor``, which the gateway answers and does not forward.

``doctor`` sends one STATUS to a peer that is silent: every OpenIGTLink program accepts it.  A gateway recognises this
STATUS by device name and text.  It replies with a STATUS of its own name, by which ``doctor`` recognises a gateway.
The probe reaches no ROS topic and no other peer; the recording has it, as every message.

A replay that waits for its peers recognises it too, replies, and goes on waiting.
"""

from __future__ import annotations

from igtl_gateway.gateway.to_igtl.sender import OutboundMessage
from igtl_gateway.wire import Message
from igtl_gateway.wire.text import Status

PROBE_DEVICE = "igtl_doctor"
#: The empty line at the end makes a web server answer, too.
PROBE = Status(1, 0, "", "igtl-gateway doctor is listening\r\n\r\n")

REPLY_DEVICE = "igtl_gateway"
#: Without a version: the reply in a recording is the same with every version.
REPLY = Status(1, 0, "", "igtl-gateway")


#: The reply of a replay that waits.
REPLAY_REPLY = Status(1, 0, "", "igtl-gateway replay")


def is_probe(message: Message) -> bool:
    """Return whether a message is the probe."""
    return message.device_name == PROBE_DEVICE and message.type == "STATUS" and message.content == PROBE


def is_reply(message: Message) -> bool:
    """Return whether a message is the reply of a gateway to the probe."""
    return message.device_name == REPLY_DEVICE and message.type == "STATUS" and message.content in (REPLY, REPLAY_REPLY)


def is_of_replay(message: Message) -> bool:
    """Return whether a reply to the probe is that of a replay."""
    return is_reply(message) and message.content == REPLAY_REPLY


def reply(now_ns: int) -> OutboundMessage:
    """Return the reply of a gateway, with its stamp (UTC ns)."""
    return OutboundMessage("STATUS", REPLY_DEVICE, REPLY, now_ns)
