"""When configured sources that do not come are reported."""

from __future__ import annotations

from igtl_gateway.app.awaited_sources import AwaitedSources
from igtl_gateway.base.stamp import NS_PER_S
from igtl_gateway.config.configuration import Config, ToIgtlRow, ToRosRow
from igtl_gateway.gateway.expected import PresentSources, expected_sources
from igtl_gateway.gateway.log.note import Note

EXPECTED = expected_sources(Config(to_igtl=(ToIgtlRow(topic="/tol"),), to_ros=(ToRosRow(device="Prob"),)))


class Bridge:
    def __init__(self) -> None:
        self.present = PresentSources(topics=(), devices=None)
        self.notes: list[Note] = []
        self.looks = 0
        self.awaited = AwaitedSources(EXPECTED, self._now, self.notes.append)

    def _now(self) -> PresentSources:
        self.looks += 1
        return self.present

    def until(self, seconds: int) -> list[str]:
        for second in range(seconds):
            self.awaited.look(100 * NS_PER_S + second * NS_PER_S)
        return [each.source.name for each in self.awaited.missing]


def test_a_source_that_does_not_come_is_reported_once_after_five_seconds() -> None:
    bridge = Bridge()
    assert bridge.until(5) == [] and not bridge.looks
    assert bridge.until(6) == ["/tol"]
    assert bridge.until(30) == ["/tol"]
    assert [note.stream for note in bridge.notes] == ["/tol"]


def test_a_device_is_missed_only_where_peers_send() -> None:
    bridge = Bridge()
    bridge.present = PresentSources(topics=("/tol",), devices=("Probe",))
    assert bridge.until(8) == [], "the peers have sent for some seconds only"
    assert bridge.until(14) == ["Prob"]


def test_a_source_that_has_come_is_not_missed_when_it_leaves() -> None:
    bridge = Bridge()
    assert bridge.until(7) == ["/tol"]
    bridge.present = PresentSources(topics=("/tol",), devices=("Prob",))
    assert bridge.until(20) == []
    bridge.present = PresentSources(topics=(), devices=("Prob",))
    assert bridge.until(40) == [] and len(bridge.notes) == 1
    looks = bridge.looks
    bridge.until(60)
    assert bridge.looks == looks, "nothing is awaited any more"
