"""Codecs, and the options of encoding."""

from __future__ import annotations

from dataclasses import dataclass

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.base.near import one_of

#: Codecs to encode with: name in CompressedImage.format → encoder and its options.
#: x264's "ultrafast" is what Full HD at 30 Hz leaves time for, and its baseline profile is what every peer decodes.
#: The bit rate is constant, over a buffer of one second.
ENCODERS: dict[str, tuple[str, dict[str, str]]] = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "scenecut=0:repeat-headers=1"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0", "row-mt": "1",
                           "auto-alt-ref": "0", "tile-columns": "2"}),
}  # fmt: skip
CODECS = tuple(ENCODERS)
_LIMITS = {"bit_rate": (10_000, 1_000_000_000), "key_frame_interval": (1, 10_000)}


@dataclass(frozen=True, slots=True)
class VideoOptions:
    """How pictures are encoded.

    Attributes:
        codec: one of ``CODECS``.
        bit_rate: bit/s of each stream.
        key_frame_interval: pictures from one key frame to the next; who joins waits for one.

    Raises ConfigError for values that cannot be.
    """

    codec: str = "h264"
    bit_rate: int = 4_000_000
    key_frame_interval: int = 30

    def __post_init__(self) -> None:
        if self.codec not in CODECS:
            raise ConfigError(f"video codec: found {self.codec!r}, expected {one_of(self.codec, CODECS)}")
        for name, (lowest, highest) in _LIMITS.items():
            value = getattr(self, name)
            if not lowest <= value <= highest:
                raise ConfigError(f"video {name}: found {value}, expected {lowest} to {highest}")
