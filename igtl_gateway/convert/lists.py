"""Lists and groups: IMGMETA, LBMETA, VIDEOMETA, COLORT, CAPABILITY and BIND ⇄ igtl_msgs.

The three META lists are read and written by columns.  Their stamps are the times of the scans.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igtl_gateway.base.errors import ConversionError, MalformedBody
from igtl_gateway.base.stamp import NS_PER_S, ns_to_ticks, ticks_to_ns
from igtl_gateway.convert import geometry, igtl_msgs
from igtl_gateway.convert.columns import check_rows, fit_texts, set_text_fields, texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.igtl_msgs import BoundMessage, ImageMeta, LabelMeta, VideoMeta
from igtl_gateway.convert.rosmsg import Header
from igtl_gateway.convert.structs import Array, Struct
from igtl_gateway.convert.units import ieee_754
from igtl_gateway.wire.bind import Bind, BindChild
from igtl_gateway.wire.body import Body
from igtl_gateway.wire.capability import Capability
from igtl_gateway.wire.colort import MAP_U16, ColorTable
from igtl_gateway.wire.elements import Elements
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.metalists import (
    IMAGE_META_DTYPE,
    LABEL_META_DTYPE,
    VIDEO_META_DTYPE,
    ImageMetaList,
    LabelMetaList,
    VideoMetaList,
)

#: Range of both protocols, ns: 2³² seconds.  OpenIGTLink stamps after 2038 are negative in ROS.
_WRAP_NS = NS_PER_S << 32
_IMAGE_TEXTS = ("name", "device_name", "modality", "patient_name", "patient_id")
_LABEL_TEXTS = ("name", "device_name", "owner")
_VIDEO_TEXTS = ("name", "device_name", "patient_name", "patient_id")
_TYPE_BYTES = 12
_CHILD_NAME_BYTES = 20  # limit of C++ readers; the protocol has none


def images_to_ros(content: ImageMetaList, to: ToRosContext) -> igtl_msgs.ImageMetaList:
    """Convert to a list with one ``ImageMeta`` for each element."""
    rows = _rows(content, *_IMAGE_TEXTS, "ticks", "size", "scalar_type")
    images = tuple(
        ImageMeta(name, device, modality, patient, patient_id, ticks_to_ns(ticks), tuple(size), scalar)
        for name, device, modality, patient, patient_id, ticks, size, scalar in rows
    )
    return igtl_msgs.ImageMetaList(_header(to), images, to.metadata)


def images_to_igtl(message: igtl_msgs.ImageMetaList, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to IMGMETA; strings that are too long are cut, with a warning."""
    elements = np.zeros(len(message.images), IMAGE_META_DTYPE)
    for name in _IMAGE_TEXTS:
        set_text_fields(elements, name, (getattr(image, name) for image in message.images), to)
    elements["ticks"] = [ns_to_ticks(image.scan_time_ns % _WRAP_NS) for image in message.images]
    _set(elements, message.images, "size", "scalar_type")
    return _outgoing(ImageMetaList(elements), message)


def labels_to_ros(content: LabelMetaList, to: ToRosContext) -> igtl_msgs.LabelMetaList:
    """Convert to a list with one ``LabelMeta`` for each element."""
    labels = tuple(
        LabelMeta(name, device, label, tuple(rgba), tuple(size), owner)
        for name, device, owner, label, rgba, size in _rows(content, *_LABEL_TEXTS, "label", "rgba", "size")
    )
    return igtl_msgs.LabelMetaList(_header(to), labels, to.metadata)


def labels_to_igtl(message: igtl_msgs.LabelMetaList, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to LBMETA; strings that are too long are cut, with a warning."""
    elements = np.zeros(len(message.labels), LABEL_META_DTYPE)
    for name in _LABEL_TEXTS:
        set_text_fields(elements, name, (getattr(label, name) for label in message.labels), to)
    _set(elements, message.labels, "label", "rgba", "size")
    return _outgoing(LabelMetaList(elements), message)


def videos_to_ros(content: VideoMetaList, to: ToRosContext) -> igtl_msgs.VideoMetaList:
    """Convert to a list with one ``VideoMeta`` for each element; lengths are in the unit of the ROS side.

    A matrix with NaN or infinity does not reject the list: its values become NaN or infinity.
    """
    to_ros = to.lengths.to_ros
    videos = []
    for name, device, patient, patient_id, zoom, focal_length, size, matrix, scalar in _rows(
        content, *_VIDEO_TEXTS, "zoom_level", "focal_length", "size", "matrix", "scalar_type"
    ):
        direction, (i, j, k) = geometry.split_axes(matrix[:9])
        x, y, z = matrix[9:]
        videos.append(
            VideoMeta(
                *(name, device, patient, patient_id, zoom, to_ros(focal_length), tuple(size), direction),
                spacing=(to_ros(i), to_ros(j), to_ros(k)),
                center=(to_ros(x), to_ros(y), to_ros(z)),
                scalar_type=scalar,
            )
        )
    return igtl_msgs.VideoMetaList(_header(to), tuple(videos), to.metadata)


@ieee_754
def videos_to_igtl(message: igtl_msgs.VideoMetaList, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to VIDEOMETA; strings that are too long are cut, with a warning.

    Raises ConversionError for matrices that float32 cannot hold.
    """
    elements = np.zeros(len(message.videos), VIDEO_META_DTYPE)
    for name in _VIDEO_TEXTS:
        set_text_fields(elements, name, (getattr(video, name) for video in message.videos), to)
    to_igtl = to.lengths.to_igtl
    for element, video in zip(elements, message.videos, strict=True):
        (i, j, k), (x, y, z) = video.spacing, video.center
        axes = geometry.join_axes(video.direction, (to_igtl(i), to_igtl(j), to_igtl(k)))
        element["matrix"] = (*axes, to_igtl(x), to_igtl(y), to_igtl(z))
        element["focal_length"] = to_igtl(video.focal_length)
        if not np.isfinite(element["matrix"]).all():
            raise ConversionError(f"{message.TYPE}: found {video}, expected finite numbers (float32)")
    _set(elements, message.videos, "zoom_level", "size", "scalar_type")
    return _outgoing(VideoMetaList(elements), message)


def colors_to_ros(content: ColorTable, to: ToRosContext) -> igtl_msgs.ColorTable:
    """Convert to ColorTable with the bytes of the table unchanged, big-endian."""
    return igtl_msgs.ColorTable(_header(to), content.index_type, content.map_type, True, content.table, to.metadata)


def colors_to_igtl(message: igtl_msgs.ColorTable, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to COLORT.  Raises ConversionError for unknown types and for a table of the wrong size."""
    content = ColorTable(message.index_type, message.map_type, message.table)
    try:
        content.check()
    except MalformedBody as error:
        raise ConversionError(f"{message.TYPE}: {error}") from None
    if content.map_type == MAP_U16 and not message.is_bigendian:
        content = replace(content, table=np.frombuffer(message.table, "u2").byteswap().view(np.uint8).data)
    return _outgoing(content, message)


def capability_to_ros(content: Capability, to: ToRosContext) -> igtl_msgs.Capability:
    """Convert to Capability with the type names unchanged, for example ``GET_CAPABIL``."""
    check_rows(content.types, "CAPABILITY")
    return igtl_msgs.Capability(_header(to), tuple(map(visible, content.types)), to.metadata)


def capability_to_igtl(message: igtl_msgs.Capability, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to CAPABILITY.  Raises ConversionError for names of more than 12 bytes, which cannot be cut."""
    types = tuple(_type_name(name, message.TYPE) for name in message.types)
    return _outgoing(Capability(types), message)


def bind_to_ros(content: Bind, to: ToRosContext) -> igtl_msgs.Bind:
    """Convert to Bind with the contents of the children unchanged."""
    children = tuple(BoundMessage(visible(each.type), visible(each.name), each.content) for each in content.children)
    return igtl_msgs.Bind(_header(to), children, to.metadata)


def bind_to_igtl(message: igtl_msgs.Bind, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to BIND.  Raises ConversionError for types of more than 12 bytes; longer names than 20 bytes are cut."""
    names = fit_texts((child.name for child in message.children), _CHILD_NAME_BYTES, "name in a BIND", to)
    children = [
        BindChild(_type_name(child.type, message.TYPE), name, child.content)
        for child, name in zip(message.children, names, strict=True)
    ]
    return _outgoing(Bind(tuple(children)), message)


def _type_name(name: str, ros_type: str) -> str:
    shown = visible(name)
    if len(shown.encode()) > _TYPE_BYTES:
        raise ConversionError(f"{ros_type}: found the type {name!r}, expected at most {_TYPE_BYTES} bytes")
    return shown


_List = (
    igtl_msgs.ImageMetaList
    | igtl_msgs.LabelMetaList
    | igtl_msgs.VideoMetaList
    | igtl_msgs.ColorTable
    | igtl_msgs.Capability
    | igtl_msgs.Bind
)


def _header(to: ToRosContext) -> Header:
    return Header(to.stamp_ns, to.frame_id)


def _rows(content: Elements, *fields: str) -> Iterator[tuple[Any, ...]]:
    """Yield some fields of each element: strings as in ``texts``, numbers as Python numbers.

    Raises ConversionError for more than MAX_ROWS elements.
    """
    elements = content.elements
    check_rows(elements, content.NAME)
    columns = (
        texts(elements, name) if elements.dtype[name].kind == "S" else elements[name].tolist() for name in fields
    )
    return zip(*columns, strict=True)


def _set(elements: Array, items: Sequence[Struct], *fields: str) -> None:
    """Fill number fields from the attributes with the same names."""
    for name in fields:
        if items:
            elements[name] = [getattr(item, name) for item in items]


def _outgoing(content: Body, message: _List) -> ConvertedMessage:
    return ConvertedMessage(content, message.header.stamp_ns, message.header.frame_id, metadata=message.metadata)
