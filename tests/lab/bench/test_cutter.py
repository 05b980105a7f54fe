"""Messages found in what a connection brings: one by one, and many at once."""

from __future__ import annotations

from igtl_gateway_lab.bench.cases import payload
from igtl_gateway_lab.bench.cutter import Arrivals, Cutter
from igtl_gateway_lab.bench.window import progress


def test_many_at_once_are_as_one_by_one() -> None:
    kinds, firsts, told = ("transform", "string-100"), [], progress()
    heard = {kind: Arrivals(lambda message: firsts.append(bytes(message)), told) for kind in kinds}
    cutter = Cutter({kind.encode().ljust(20, b"\0"): (payload(kind).forms[1], heard[kind]) for kind in kinds})
    made = {
        kind: [bytes(payload(kind).igtl_maker(kind)(number)) for number in (0, *range(1, 41), 0, *range(41, 61))]
        for kind in kinds
    }
    stranger = bytes(payload("transform").igtl_maker("stranger")(1))
    data = [*made["transform"][:30], *made["string-100"][:25], stranger, *made["transform"][30:], stranger]
    for at_ns, piece in enumerate((b"".join(data), b"".join(made["string-100"][25:]))):
        cutter.room()[: len(piece)] = piece
        cutter.take(len(piece), at_ns)
    assert firsts == [made[kind][0] for kind in kinds]
    for kind in kinds:
        assert list(heard[kind].numbers) == list(range(1, 61))
    assert list(heard["string-100"].times) == [0] * 24 + [1] * 36
    assert told[0] == 60
