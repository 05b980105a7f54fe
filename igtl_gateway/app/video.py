"""Pictures of ROS as VIDEO and back: what is encoded, what is decoded, and where that meets the log.

An encoder gives other bytes on another machine, so it stands outside the gateway: pictures go in before the hub,
and what comes out of the encoder is the input that is recorded, replayed and verified.  The other way round, the
encoded frame is in the log, and the picture that is decoded from it is only published.
"""

from __future__ import annotations

from typing import Any

from igtl_gateway.app.hub import Hub
from igtl_gateway.config import Config
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Image
from igtl_gateway.edges.ros.edge import RosEdge
from igtl_gateway.edges.video import VideoDecoder, VideoEncoder, VideoOptions
from igtl_gateway.qos import Qos
from igtl_gateway.session.entry import Entry, Kind

_PICTURES = Qos(depth=5)
_ENCODED = "compressed_image"
_TYPES = ("", "VIDEO")


class VideoCodecs:
    """The encoder and the decoder of a bridge.

    Args:
        options: codec and its settings.
        config: says which topics go out.
        hub: gets the encoded frames.
        ros: gets the decoded pictures.
    """

    def __init__(self, options: VideoOptions, config: Config, hub: Hub, ros: RosEdge) -> None:
        self._config = config
        self._ros = ros
        self._encoder = VideoEncoder(options, on_frame=hub.ros, on_note=hub.note)
        self._decoder = VideoDecoder(on_image=self._publish, on_note=hub.note)

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """How to subscribe to a topic whose pictures are to be encoded, None for any other."""
        row = self._config.row_to_igtl(topic) if ros_type == Image.TYPE else None
        return (row.qos or _PICTURES) if row and row.type in _TYPES else None

    def encode(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> bool:
        """A message of ROS; whether it was for the encoder."""
        if self.subscription(topic, ros_type) is None:
            return False
        self._encoder.submit(topic, cdr, source_ns)
        return True

    def decode(self, entry: Entry) -> None:
        """Decode what goes to ROS as an encoded frame."""
        if entry.kind is Kind.ROS_OUT and entry.type == CompressedImage.TYPE:
            self._decoder.submit(entry.channel, entry.payload[0])

    def _publish(self, topic: str, cdr: bytes) -> None:
        self._ros.publish(topic.removesuffix(_ENCODED) + "image", Image.TYPE, cdr, _PICTURES)

    def counters(self) -> dict[str, Any]:
        """What became of every picture."""
        return {"encoder": self._encoder.counters(), "decoder": self._decoder.counters()}

    def stop(self) -> None:
        """End both threads."""
        self._encoder.stop()
        self._decoder.stop()
