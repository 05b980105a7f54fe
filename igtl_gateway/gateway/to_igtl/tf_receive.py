"""Processes /tf and /tf_static from ROS for the frames in ``tf_out`` of the configuration."""

from __future__ import annotations

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.config.configuration import TfOutRow
from igtl_gateway.convert.common_msgs import TFMessage
from igtl_gateway.gateway.guard import Guard
from igtl_gateway.gateway.guarded_stream import findings_of
from igtl_gateway.gateway.log.entry import Entry
from igtl_gateway.gateway.log.fates import CONVERTED
from igtl_gateway.gateway.log.note import Level
from igtl_gateway.gateway.outcome import Finding, Item, Outcome, conversion_failure
from igtl_gateway.gateway.peers import Peer, Peers
from igtl_gateway.gateway.to_igtl.delivery import Delivery
from igtl_gateway.gateway.to_igtl.tf_out import TF_TOPICS, TfOut
from igtl_gateway.gateway.to_igtl.tracking import Tracking


class TfReceiver:
    """Receives /tf and /tf_static; false if ``tf_out`` is empty."""

    def __init__(self, tf: TfOut, guard: Guard, peers: Peers, delivery: Delivery, tracking: Tracking) -> None:
        self._tf = tf
        self._guard = guard
        self._peers = peers
        self._delivery = delivery
        self._tracking = tracking

    def __bool__(self) -> bool:
        return bool(self._tf)

    def takes(self, entry: Entry) -> bool:
        """Return whether an entry is a message of /tf or /tf_static that is needed."""
        return bool(self._tf) and entry.channel in TF_TOPICS and entry.type == TFMessage.TYPE

    def take(self, entry: Entry, *, sends: bool = True) -> Outcome:
        """Process a message of /tf or /tf_static; ``sends``: False only changes the tree."""
        try:
            message = TFMessage.unpack(entry.payload[0])
        except ConversionError as error:
            return Outcome([conversion_failure(error, "not sent", entry)], "conversion")
        return Outcome(self.update(entry, message, static=TF_TOPICS[entry.channel], sends=sends), CONVERTED)

    def update(self, entry: Entry, message: TFMessage, *, static: bool, sends: bool = True) -> list[Item]:
        """Return the outputs and findings of a change of the tf tree."""
        items: list[Item] = []

        def is_stale(row: TfOutRow, frame: str, stamp_ns: int) -> bool:
            watched = self._guard.of(0, f"frame {frame} in {row.base}", self._tf.max_age_of(row))
            withheld, findings = watched.judge(entry.stamp_ns, stamp_ns) if watched else (False, [])
            items.extend(findings_of(entry, findings))
            return withheld

        changed, problems = self._tf.update(message, static, entry.stamp_ns, is_stale)
        items += [Finding(Level.ERROR, "conversion", f"not sent: {text}", entry.channel) for text in problems]
        if not sends:
            return items
        lengths = {out.channel: lengths for out, lengths in changed}
        outs = [out for out, _ in changed]
        items += self._delivery.deliver_each(
            entry,
            outs,
            lambda out: self._delivery.deliver_streams(entry, [(self._peers.all(), out)], lengths[out.channel]),
        )
        # tracking data contains all poses: once for each type, however many poses have changed
        last = {out.igtl_type: out for out in outs}
        return items + self._delivery.deliver_each(
            entry,
            last.values(),
            lambda out: self._delivery.deliver_streams(
                entry, self._tracking.due_after(entry, out), lengths[out.channel]
            ),
        )

    def send_static(self, entry: Entry, peer: Peer) -> list[Item]:
        """Return the static frames for a new peer."""
        return self._delivery.deliver_each(
            entry, self._tf.static(), lambda out: self._delivery.to(entry, [peer], [out])
        )
