"""Many messages of a topic, drawn at once by the function that draws one.

Messages of a stream mostly differ in numbers and stamps only: they have one *form*.  Read by CdrRows they are one
message whose numbers are columns.  The function of the table draws it on a :class:`RowsCanvas`, which passes rows of
columns to the canvas of the topic.  Other messages raise Unlike, and are drawn one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from igtl_gateway.addon import ConversionError
from igtl_gateway.addon.ros import CdrRows
from igtl_gateway.addons.view.canvas import HUGE, Canvas
from igtl_gateway.addons.view.columns import Rows
from igtl_gateway.addons.view.pen import LAST_NS

if TYPE_CHECKING:
    from igtl_gateway.addons.view.table import Picture

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]


class Unlike(Exception):
    """The messages are not drawn at once.

    Attributes:
        good: mask of the messages that are unlike the others; None: they are drawn one by one.
    """

    def __init__(self, good: npt.NDArray[np.bool_] | None = None) -> None:
        super().__init__()
        self.good = good


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """What messages have in common that differ in numbers only.

    Attributes:
        sample: one of them.
        spans: the bytes that they share; what is between them is numbers, stamps and padding.
        changes: `Pen.changes` when it was drawn: with another owner a frame is drawn elsewhere.
    """

    sample: Bytes
    spans: tuple[slice, ...]
    changes: int

    @classmethod
    def of(cls, data: bytes, picture: Picture, canvas: Canvas) -> Form | None:
        """The form of a message that was just drawn; None if messages like it are drawn one by one."""
        sample = np.frombuffer(data, np.uint8)
        fixed = np.zeros(len(sample), np.bool_)
        try:
            message = picture.message.read(CdrRows(sample[None], picture.message.TYPE, fixed))
            picture.draw(message, RowsCanvas(canvas, 1))
        except (Unlike, ConversionError, ValueError):
            return None
        edges = np.flatnonzero(np.diff(fixed, prepend=False, append=False)).tolist()
        return cls(sample, tuple(map(slice, edges[::2], edges[1::2])), canvas.pen.changes)

    def fits(self, messages: Bytes) -> npt.NDArray[np.bool_]:
        """Mask of the messages (n, size) that have this form."""
        found = np.ones(len(messages), np.bool_)
        for span in self.spans:
            found &= (messages[:, span] == self.sample[span]).all(axis=1)
        return found


class RowsCanvas:
    """What the function that draws a message draws many on.

    Nothing is drawn before ``draw``: a function that ends by Unlike has drawn nothing.
    """

    def __init__(self, canvas: Canvas, count: int) -> None:
        self._canvas, self._count = canvas, count
        self._calls: list[Callable[[], None]] = []
        self.frame, self.part, self.static, self.set_kind = canvas.frame, canvas.part, canvas.static, canvas.set_kind
        self.pen, self.shown, self.memory, self.options = canvas.pen, canvas.shown, canvas.memory, canvas.options

    def __getattr__(self, name: str) -> Any:
        raise Unlike

    @property
    def robots(self) -> RowsCanvas:
        """Robots that nothing moves: each message of one that is moved is drawn alone."""
        if self._canvas.robots:
            raise Unlike
        return self

    def move(self, *_: Any) -> None:
        """Move no robot."""

    def text_once(self, text: str, about: str = "") -> None:
        """Write no line that was written before."""
        if not self._canvas.has_stated(about or text):
            raise Unlike

    def is_pose(self, pose: Sequence[Array]) -> bool:
        """As the canvas; Unlike if one is a pose and another is not."""
        turn = pose[3:]
        if all(part.min() > -HUGE and part.max() < HUGE for part in pose) and any((part != 0).all() for part in turn):
            return True
        good = np.all([np.abs(part) < HUGE for part in pose], axis=0) & np.any([part != 0 for part in turn], axis=0)
        if good.all() or not good.any():
            return bool(good[0])
        raise Unlike(good)

    def tool(self, pose: Sequence[Array], frame: str, child: str = "", *, labelled: bool = True) -> None:
        """As the canvas."""
        if not self._canvas.is_trailed(child):
            raise Unlike
        self._calls.append(lambda: self._canvas.tool(pose, frame, child, labelled=labelled))

    def extend_box(self, place: Sequence[Array]) -> None:
        """As the canvas."""
        self._calls.append(lambda: self._canvas.extend_box(place))

    def link(self, child: str, frame: str, pose: Sequence[Array], *, static: bool = False) -> None:
        """As the canvas."""
        if not self._canvas.is_settled(child, static=static):
            raise Unlike
        self._calls.append(lambda: self._canvas.link(child, frame, pose, static=static))

    def numbers(self, values: Sequence[Any], child: str = "") -> None:
        """As the canvas."""
        self._calls.append(lambda: self._canvas.numbers(values, child))

    def draw(self, rows: Rows) -> None:
        """Draw all of it."""
        self.pen.at_rows(rows)
        for call in self._calls:
            call()


def drawing_of(messages: Bytes, picture: Picture, canvas: Canvas, rows: Rows) -> Callable[[], None]:
    """What draws messages of one form.  Raises Unlike, ConversionError, ValueError.

    Args:
        messages: (n, size).
        picture: row of the table.
        canvas: of the topic.
        rows: the times of the entries.
    """
    message = picture.message.read(CdrRows(messages, picture.message.TYPE))
    drawing = RowsCanvas(canvas, len(rows))
    picture.draw(message, drawing)
    stamps = stamp_of(message)
    sources = np.where((stamps > 0) & (stamps <= LAST_NS), stamps, rows.sources)
    return lambda: drawing.draw(Rows(rows.numbers, rows.stamps, sources))


def stamp_of(message: Any) -> Any:
    """The stamp in the header of a message, or of its first transform, UTC ns; 0 = unset."""
    first = next(iter(getattr(message, "transforms", ())), message)
    return getattr(getattr(first, "header", None), "stamp_ns", 0)
