"""CameraInfo, which no conversion uses: its bytes are those of independent serialisers."""

from __future__ import annotations

import numpy as np
from rosbags.typesys import Stores, get_typestore

from igtl_gateway.convert.common_msgs import CameraInfo, RegionOfInterest
from igtl_gateway.convert.rosmsg import Header

INFO = CameraInfo(
    Header(1_700_000_000_123_456_789, "camera"),
    240,
    320,
    "plumb_bob",
    np.array([0.1, -0.2, 0.003, 0.0, 0.5]),
    (1142.0, 0.0, 159.5, 0.0, 1143.0, 119.5, 0.0, 0.0, 1.0),
    (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
    (1142.0, 0.0, 159.5, 7.0, 0.0, 1143.0, 119.5, 8.0, 0.0, 0.0, 1.0, 9.0),
    2,
    4,
    RegionOfInterest(1, 2, 3, 4, True),
)


def test_rosbags_reads_camera_info_and_writes_the_same_bytes() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    message = store.deserialize_cdr(INFO.pack(), INFO.TYPE)
    assert (message.header.frame_id, message.height, message.width) == ("camera", 240, 320)  # type: ignore[attr-defined]
    assert message.d.tolist() == INFO.d.tolist()  # type: ignore[attr-defined]
    assert tuple(message.k) == INFO.k and tuple(message.p) == INFO.p  # type: ignore[attr-defined]
    roi = message.roi  # type: ignore[attr-defined]
    assert (roi.x_offset, roi.y_offset, roi.height, roi.width, roi.do_rectify) == (1, 2, 3, 4, True)
    assert bytes(store.serialize_cdr(message, INFO.TYPE)) == INFO.pack()


def test_camera_info_comes_back_as_it_was() -> None:
    back = CameraInfo.unpack(INFO.pack())
    assert back.d.tolist() == INFO.d.tolist()
    assert [getattr(back, name) for name in ("header", "k", "r", "p", "binning_x", "binning_y", "roi")] == [
        getattr(INFO, name) for name in ("header", "k", "r", "p", "binning_x", "binning_y", "roi")
    ]
