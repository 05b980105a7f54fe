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
_EIGHT, _COLOURS = 8, 3


def decoded_still(codec: str, data: bytes, *, is_shape_alone: bool = False) -> npt.NDArray[Any]:
    """Return (rows, columns, 3) uint8 RGB; of more than 8 bits uint16: (rows, columns) of grey, (rows, columns, 3) RGB.

    With ``is_shape_alone`` the data are decoded, but not converted to RGB, and all elements are 0, read-only.

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
        picture, components = found[0], found[0].format.components
        is_deep, is_grey = max(each.bits for each in components) > _EIGHT, len(components) < _COLOURS
        if is_shape_alone:
            shape = (picture.height, picture.width, *((_COLOURS,) if not (is_deep and is_grey) else ()))
            return np.broadcast_to(np.zeros((), np.uint16 if is_deep else np.uint8), shape)
        deep = "gray16le" if is_grey else "rgb48le"
        pixels = picture.to_ndarray(format=deep if is_deep else "rgb24")
    except av.FFmpegError as error:
        raise ConversionError(f"found damaged {codec} data: {error}") from None
    return np.ascontiguousarray(pixels)
