"""Single encoded pictures as pixels: JPEG and PNG, with all bits that they have."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.pictures import JPEG, PNG
from igtl_gateway.edges.video.worker import MAX_PIXELS, import_av

_DECODERS = {JPEG: "mjpeg", PNG: "png"}
_EIGHT = 8


def decoded_still(codec: str, data: bytes) -> npt.NDArray[Any]:
    """Return (rows, columns, 3) uint8 RGB; of more than 8 bits uint16: (rows, columns) of grey, (rows, columns, 3) RGB.

    Raises ConversionError for damaged data, Unavailable if PyAV is missing.
    """
    av = import_av()
    decoder = av.CodecContext.create(_DECODERS[codec], "r")
    decoder.options = {"max_pixels": str(MAX_PIXELS), "err_detect": "explode"}
    decoder.thread_count = 1
    try:
        found = [*decoder.decode(av.Packet(data)), *decoder.decode(None)] if data else []
        if not found:
            raise ConversionError(f"found {counted(len(data), 'byte')} without a picture, expected {codec}")
        components = found[0].format.components
        if max(each.bits for each in components) <= _EIGHT:
            pixels = found[0].to_ndarray(format="rgb24")
        else:
            pixels = found[0].to_ndarray(format="gray16le" if len(components) < 3 else "rgb48le")
    except av.FFmpegError as error:
        raise ConversionError(f"found damaged {codec} data: {error}") from None
    return np.ascontiguousarray(pixels)
