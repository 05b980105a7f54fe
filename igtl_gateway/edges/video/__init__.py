"""Pictures to encoded video and back, by PyAV (FFmpeg), each direction in a thread of its own.

No two builds of an encoder give the same bytes, so it is an edge: its frames enter the log as inputs, and a replay
never encodes again.  One picture in gives one frame out, at once: no B frames, no look-ahead, no frame threads.

* *Encoding* (``encoder``) may be slower than the camera.  Raw pictures wait in a short queue of each topic; at its
  bound the oldest is dropped, which costs a picture and nothing else.
* *Decoding* (``decoder``) cannot skip a frame, because the next frames are differences from it.  After a frame that is
  broken, or was dropped here, all frames up to the next key frame are dropped: no picture is better than one with parts
  of another.  (A frame that was lost before it reached us is invisible: FFmpeg paints over it.)

Measured on two cores, per picture, VGA and Full HD: to encode H.264 5 and 18 ms, VP9 10 and 54 ms; to decode H.264 2
and 6 ms, VP9 4 and 13 ms.  Twice that where other programs need the cores as well.

PyAV is imported when the first of the two is made, so that this package loads without it.
"""

from igtl_gateway.edges.video.decoder import MAX_FRAMES, VideoDecoder
from igtl_gateway.edges.video.encoder import MAX_PICTURES, VideoEncoder
from igtl_gateway.edges.video.options import CODECS, VideoOptions
from igtl_gateway.edges.video.worker import MAX_STREAMS

__all__ = ["CODECS", "MAX_FRAMES", "MAX_PICTURES", "MAX_STREAMS", "VideoDecoder", "VideoEncoder", "VideoOptions"]
