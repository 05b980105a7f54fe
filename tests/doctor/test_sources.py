"""What of a configuration a session does not have: in a recording, and on a ROS graph."""

from __future__ import annotations

from igtl_gateway.base.buffers import join
from igtl_gateway.base.qos import Endpoint, Qos
from igtl_gateway.config.configuration import Config
from igtl_gateway.convert.common_msgs import FrameTransform, TFMessage
from igtl_gateway.convert.rosmsg import Header, String, TransformStamped
from igtl_gateway.doctor.graph import Graph
from igtl_gateway.doctor.observer import Observer
from igtl_gateway.doctor.rules import judge
from igtl_gateway.gateway import Gateway
from igtl_gateway.gateway.expected import expected_sources
from igtl_gateway.gateway.log.entry import Entry, Kind
from igtl_gateway.gateway.log.note import Level, Note
from igtl_gateway.wire import Message, encode
from igtl_gateway.wire.text import String as IgtlString
from tests.tables import table

CONFIG = Config.from_dict(
    {
        "to_igtl": [{"topic": "/tol"}, {"topic": "/words"}, {"topic": "/odd", "type": "IMAGE"}, {"topic": "/lidar/*"}],
        "to_ros": [{"device": "Prob"}, {"device": "Probe", "type": "IMAGE"}, {"device": "Tool*"}],
        "tf_out": [{"frames": ["tip", "elbow"], "base": "base"}],
        "crtk": [{"arms": "/PSM*"}],
        "peers": [{"at": "10.0.0.9:18944", "profile": "plus"}],
    }
)


def tf(parent: str, child: str) -> bytes:
    return TFMessage((FrameTransform(Header(1, parent), child, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),)).pack()


def entries() -> list[Entry]:
    up = Note(Level.INFO, "link_up", "up", data={"peer": "10.0.0.7:18944", "local": "10.0.0.1:5", "role": "client"})
    text = String("a").pack()
    device = join(encode(Message("STRING", "Probe", IgtlString.of("a"), 1 << 32)))
    made = [
        Entry(1, 1, Kind.LINK, payload=(up.pack(),), links=(1,)),
        Entry(2, 2, Kind.IGTL_IN, "STRING/Probe", "STRING", (device,), (1,)),
        *(Entry(3, 3, Kind.ROS_IN, topic, String.TYPE, (text,)) for topic in ("/words", "/tool", "/odd")),
        Entry(4, 4, Kind.ROS_IN, "/tf", TFMessage.TYPE, (tf("base", "tip"),)),
        Entry(5, 5, Kind.ROS_IN, "/tf_static", TFMessage.TYPE, (tf("bed", "elbo"),)),
    ]
    return made


def findings(seen: Observer) -> list[str]:
    return [finding.match.text for finding in judge(seen) if finding.rule.id == "IGTL-W607"]


def observed(*more: Entry, config: Config = CONFIG) -> Observer:
    seen = Observer(config)
    seen.sources.is_recording = True
    for entry in (*entries(), *more):
        seen.add(entry)
    return seen


OF_TOPICS = [
    "topic /tol: no publisher; did you mean '/tool'? (to_igtl[0])",
    f"topic /odd: {String.TYPE} has no conversion to IMAGE (to_igtl[2])",
    "topic /lidar/*: no publisher (to_igtl[3])",
]
FOUND = [
    *OF_TOPICS,
    "frame elbow: not on /tf or /tf_static; did you mean 'elbo'? (tf_out[0])",
    "arm /PSM*: no publisher below it (crtk[0])",
    "device Prob: no peer sends it; did you mean 'Probe'? (to_ros[0])",
    "device Probe: it is STRING, expected IMAGE (to_ros[1])",
    "device Tool*: no peer sends it (to_ros[2])",
    "peer 10.0.0.9:18944: no such peer; did you mean '10.0.0.7:18944'? (peers[0])",
]


def test_what_a_recording_of_a_configuration_does_not_have() -> None:
    assert findings(observed()) == FOUND


def test_a_frame_that_comes_late_and_one_that_is_not_connected() -> None:
    late = [Entry(6, 6, Kind.ROS_IN, "/tf", TFMessage.TYPE, (tf("base", "tip"),))] * 1_500
    late.append(Entry(7, 7, Kind.ROS_IN, "/tf", TFMessage.TYPE, (tf("bed", "elbow"),)))
    found = findings(observed(*late))
    assert "frame elbow: no transform connects it with base (tf_out[0])" in found
    assert not [each for each in found if "not on /tf" in each]


@table(
    ("globs", "missing"),
    [((("STRING/*",), ()), 0), ((("/tol", "/lidar/*"), ()), 2), (((), ("/tol",)), 2), (((), ()), 3)],
)
def test_what_was_not_recorded_may_have_come(globs: tuple[tuple[str, ...], tuple[str, ...]], missing: int) -> None:
    seen = observed()
    seen.sources.selected = globs
    assert len([each for each in findings(seen) if each.startswith("topic")]) == missing


def noted(code: str, name: str) -> Entry:
    note = Note(Level.WARN, code, f"topic {name}: no publisher (--record-topics)", name, {"setting": "--record-topics"})
    return Entry(8, 8, Kind.EDGE_NOTE, payload=(note.pack(),))


def test_a_note_that_was_withdrawn_is_no_finding() -> None:
    seen = observed(noted("no_source", "/cloud"), noted("no_source", "/late"), noted("source_came", "/late"))
    seen.add(noted("no_source", "/words"))  # it was there, and left before the end
    assert [each for each in findings(seen) if each not in FOUND] == ["topic /cloud: no publisher (--record-topics)"]


def test_a_graph_without_peers() -> None:
    seen = Observer(CONFIG)
    endpoints = [Endpoint("/tool", TransformStamped.TYPE, "/robot", True, Qos()),
                 Endpoint("/odd", String.TYPE, "/robot", True, Qos())]  # fmt: skip
    seen.graph = Graph.of(Gateway(CONFIG), {}, endpoints)
    seen.sources.reads_tf = True
    seen.sources.expected = expected_sources(CONFIG, connect=["10.0.0.5:18944"])
    seen.sources.links = {"10.0.0.5:18944": False}
    found = findings(seen)
    assert found[0] == OF_TOPICS[0] and OF_TOPICS[1] in found
    assert {"frame tip: not on /tf or /tf_static (tf_out[0])", "device Prob: no peer is connected (to_ros[0])",
            "link 10.0.0.5:18944: no answer (connect)"} <= set(found)  # fmt: skip
