"""Depth as LeRobot 0.6 and later read it: codes of 12 bits in a lossless video, and the window that they stand for.

LeRobot has 12 bits of depth, because decoders of 16 bits are rare; it divides a window into 4,095 steps.  Here these
are equal, so that a window of 4,095 mm has every millimetre.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addons.lerobot.stats import PictureStats

Array = npt.NDArray[Any]
Window = tuple[float, ...]

CODEC, PIXEL_FORMAT = "hevc", "gray12le"
LEVELS = 1 << 12
#: Rows and columns from which on the encoder takes pictures.
LEAST_SIZE = 16
_MM_PER_M, _WINDOW = 1000.0, "depth_window_mm"


def millimetres(plane: Array) -> Array:
    """Return depth (…) in mm as float64: integers are mm and other numbers metres, as in ROS (REP 118) and LeRobot."""
    found = plane.astype(np.float64)
    return found if plane.dtype.kind in "iu" else found * _MM_PER_M


def step_of(window: Window) -> float:
    """Return the step between two codes, mm."""
    return (window[1] - window[0]) / (LEVELS - 1)


def codes_of(depth_mm: Array, window: Window) -> npt.NDArray[np.uint16]:
    """Return depth (…), mm, as codes from 0 to 4095; what is outside of the window, and NaN, has the code of an end."""
    found = np.rint((np.nan_to_num(depth_mm, nan=window[0]) - window[0]) / step_of(window))
    return np.clip(found, 0, LEVELS - 1).astype(np.uint16)


def depth_of(codes: Array, window: Window) -> Array:
    """Return codes (…) as depth in mm."""
    return window[0] + codes * step_of(window)


def outside(depth_mm: Array, window: Window) -> int:
    """Return the number of pixels outside of the window, or without a depth."""
    return int(np.sum(~((depth_mm >= window[0]) & (depth_mm <= window[1]))))


def depth_info(size: tuple[int, int], fps: int, window: Window) -> dict[str, Any]:
    """Return the description of a video of depth for info.json: what LeRobot needs, and the window in mm."""
    return {
        "video.height": size[0],
        "video.width": size[1],
        "video.codec": CODEC,
        "video.pix_fmt": PIXEL_FORMAT,
        "video.fps": fps,
        "video.channels": 1,
        "has_audio": False,
        "is_depth_map": True,
        "depth_unit": "mm",
        _WINDOW: list(window),
        "video.depth_min": window[0] / _MM_PER_M,
        "video.depth_max": window[1] / _MM_PER_M,
        "video.shift": 0.0,
        "video.use_log": False,
    }


def no_stats(feature: Mapping[str, Any]) -> PictureStats | None:
    """Return statistics of no picture, to which those of a feature of info.json can be added; None for other codes."""
    if not has_codes(feature):
        return PictureStats()
    window = feature["info"].get(_WINDOW)
    is_known = isinstance(window, list) and len(window) == 2 and all(type(each) in (int, float) for each in window)
    return depth_stats(window) if is_known else None


def depth_stats(window: Window) -> PictureStats:
    """Return statistics of no picture of depth."""
    return PictureStats(np.zeros((1, LEVELS), np.int64), 0, *map(float, window))


def has_codes(feature: Mapping[str, Any]) -> bool:
    """Return whether a feature of info.json is a video of such codes."""
    info = feature.get("info")
    return isinstance(info, dict) and info.get("is_depth_map") is True and info.get("video.pix_fmt") == PIXEL_FORMAT
