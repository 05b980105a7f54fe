"""ROS images as VIDEO and back: which topics are encoded and decoded, and how the codecs connect to the log.

The bytes of an encoder differ between machines, so it is outside of the gateway's core.  Images are encoded before the
hub, and the encoded frames are the inputs that are recorded, replayed and verified.  In the other direction the encoded
frame is in the log, and the decoded image is only published.
"""

from __future__ import annotations

from typing import Any

from igtl_gateway.app.hub import Hub
from igtl_gateway.base.qos import Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import CompressedImage
from igtl_gateway.convert.rosmsg import Image
from igtl_gateway.edges.interface import RosSide
from igtl_gateway.edges.video import VideoDecoder, VideoEncoder, VideoOptions
from igtl_gateway.gateway.log.entry import Entry, Kind

_IMAGES = Qos(depth=5)
_ENCODED = "compressed_image"
_TYPES = ("", "VIDEO")


class VideoCodecs:
    """The encoder and the decoder of a bridge.

    Args:
        options: codec and its settings.
        config: has the topics that are sent as VIDEO.
        hub: receives the encoded frames.
        ros: publishes the decoded images.
    """

    def __init__(self, options: VideoOptions, config: Config, hub: Hub, ros: RosSide) -> None:
        self._config = config
        self._ros = ros
        self._encoder = VideoEncoder(options, on_frame=hub.ros, on_note=hub.note)
        self._decoder = VideoDecoder(on_image=self._publish, on_note=hub.note)

    def subscription(self, topic: str, ros_type: str) -> Qos | None:
        """Return the QoS for a topic whose images are encoded, None for any other topic."""
        row = self._config.row_to_igtl(topic) if ros_type == Image.TYPE else None
        return (row.qos or _IMAGES) if row and row.type in _TYPES else None

    def encode(self, topic: str, ros_type: str, cdr: bytes, source_ns: int) -> bool:
        """Pass a ROS message to the encoder; return False if its topic is not encoded."""
        if self.subscription(topic, ros_type) is None:
            return False
        self._encoder.submit(topic, cdr, source_ns)
        return True

    def decode(self, entry: Entry) -> None:
        """Pass an entry to the decoder if it is an encoded frame for ROS."""
        if entry.kind is Kind.ROS_OUT and entry.type == CompressedImage.TYPE:
            self._decoder.submit(entry.channel, entry.payload[0])

    def _publish(self, topic: str, cdr: bytes) -> None:
        self._ros.publish(topic.removesuffix(_ENCODED) + "image", Image.TYPE, cdr, _IMAGES)

    def counters(self) -> dict[str, Any]:
        """Return the counts of encoder and decoder: images by fate."""
        return {"encoder": self._encoder.counters(), "decoder": self._decoder.counters()}

    def start(self) -> None:
        """Start the threads of both codecs; what has come before that waits for them."""
        self._encoder.start()
        self._decoder.start()

    def stop(self) -> None:
        """Stop the threads of both codecs."""
        self._encoder.stop()
        self._decoder.stop()
