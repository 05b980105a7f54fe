"""The coordinator of a run: it decides which event is next, and routes what the programs send.

An event is a recorded input, a message from one program to another, or a deadline (timer, timeout) within a program.
The next one is that of the least session time; of one time, inputs come before messages and those before deadlines;
inputs in the order of the recording, messages in that of their sending, deadlines in the order of the programs.

A program may go on by itself up to the next event that is not its own.  It stops earlier if it sends what another
program receives, or makes or removes an entity.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.messages import ACTION_SERVICES, ACTION_TOPICS, IN_ACTION, SERVICE_EVENT, action_of
from igtl_gateway.addon.reading import PlayedAction, Qos, RecordedRequests, RecordedService, incompatible
from igtl_gateway.addon.terminal import count_text, duration_text
from igtl_gateway.addons.resim import frames
from igtl_gateway.addons.resim.frames import ALL, DEADLINE, MESSAGE, NEVER, EntityFrame
from igtl_gateway.addons.resim.inputs import CLOCK, Inputs, RecordedInput, RecordedTopic
from igtl_gateway.addons.resim.link import AnyLink, Gone
from igtl_gateway.addons.resim.outputs import OutputFile, OutputStream

#: Messages and bytes that are sent to a program at once.
_BATCH, _BATCH_BYTES = 512, 1 << 20
#: At the end of the session, a callback may sleep for this time: it returns then.  Longer is forever.
_LONGEST_SLEEP_NS = 60_000_000_000
_YEAR_NS = 365 * 86_400_000_000_000
#: Stand for the number of a program: the message is one of an action of the recording, or a recorded request.
_OF_RECORDING, _REQUESTED = -1, -2
#: The number of a program that programs see as that of recorded clients.
_RECORDING = (1 << 32) - 1
#: Place of a service, and number of its request.
_ASKED = struct.Struct("=II")
#: Messages of the programs at one session time; more are a flood.
_MOST_AT_ONCE = 100_000


class ProgramFault(GatewayError):
    """A program did what a re-simulation cannot go on with; ``is_end``: it closed its connection."""

    def __init__(self, text: str, *, is_end: bool = False) -> None:
        super().__init__(text)
        self.is_end = is_end


@dataclass(slots=True)
class Entity:
    """An entity of a program: what its frame states, and for a subscription whether it receives recorded messages."""

    frame: EntityFrame
    takes_recorded: bool = True
    stream: OutputStream | None = None

    @property
    def qos(self) -> Qos:
        return Qos(self.frame.depth, self.frame.reliable, self.frame.latched)


@dataclass(slots=True)
class Peer:
    """A process of a program.

    Attributes:
        index: its number, from 0: the order of programs.
        name: of its program, for messages.
        link: its connection.
        entities: by their numbers.
        idle: where it waits.
        batch: messages that are sent at once; adapts to how many it uses before it stops.
    """

    index: int
    name: str
    link: AnyLink
    entities: dict[int, Entity] = field(default_factory=dict)
    idle: frames.Idle = field(default_factory=lambda: frames.Idle(0, NEVER, DEADLINE, 0))
    batch: int = 64
    outbox: list[bytes] = field(default_factory=list)

    def named(self, kind: str, name: str) -> list[Entity]:
        return [each for each in self.entities.values() if each.frame.kind == kind and each.frame.name == name]


@dataclass(slots=True)
class Lost:
    """Messages of a topic or service that a full queue of a program has dropped.

    Attributes:
        program: its name.
        name: the topic or service.
        depth: of the queue.
        first_ns: session time of the first one, UTC ns.
        count: their number.
    """

    program: str
    name: str
    depth: int
    first_ns: int
    count: int = 0

    def text(self, start_ns: int) -> str:
        """One line for a person; ``start_ns``: start of the session."""
        return (
            f"{self.program}: lost {count_text(self.count, 'message')} of {self.name}, the first one at "
            f"{(self.first_ns - start_ns) / 1e9:.6f} s: its queue of depth {self.depth} was full"
        )


#: The programs that receive a recorded message, and the numbers of their subscriptions; () for all of the topic.
Receivers = list[tuple[Peer, tuple[int, ...]]]


@dataclass(slots=True)
class Roles:
    """What the topics of a run are.

    Attributes:
        inputs: topics that the recording drives, with the number of its messages.
        outputs: topics that programs publish.
        between: topics that one program publishes and another one, or itself, receives.
        missing: topics that programs ask for and nothing has.
        unused: recorded topics that no program asks for.
        expected: recorded topics that programs publish themselves: what they are compared with.
        refused: topics that a program does not receive, and why.
        answered: services that programs call and none offers, with the number of their recorded answers.
        unserved: services without one.
        played: actions that programs call and none offers, with the number of their recorded goals.
        asked: services that programs offer and the recording calls, with the number of their recorded requests.
    """

    inputs: dict[str, int] = field(default_factory=dict)
    outputs: list[str] = field(default_factory=list)
    between: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)
    answered: dict[str, int] = field(default_factory=dict)
    unserved: list[str] = field(default_factory=list)
    played: dict[str, int] = field(default_factory=dict)
    asked: dict[str, int] = field(default_factory=dict)


class Coordinator:
    """Drives the processes of one run through the session.

    Args:
        peers: the processes, which have sent their hello and got their welcome.
        inputs: the messages of the recording.
        topics: its ROS topics.
        services: those whose answers it has; they are used up.
        actions: those whose goals it has.
        requests: those of its services, for the programs that offer them.
        outputs: where outputs go.
        start_ns, end_ns: session time of the run.
        since_ns: session time from which on there are recorded requests.
        latency_ns: from the sending of a message to its arrival.
        is_input: whether a recorded topic is an input although a program publishes it (True), is not one (False), or
            follows from the programs (None).
        on_start: called when all programs wait for the first time, with the roles of the topics.
        on_event: called before a program goes on.
        on_remark: called with the name of a program, and what it does beside ROS.
        most_outputs: messages that the programs may publish.
        input_class: class of recorded inputs: `INPUT`, or `DEADLINE` with swapped ties.
    """

    def __init__(
        self,
        peers: list[Peer],
        inputs: Inputs,
        topics: Mapping[str, RecordedTopic],
        services: Mapping[str, RecordedService],
        actions: Mapping[str, PlayedAction],
        requests: Mapping[str, RecordedRequests],
        outputs: OutputFile,
        *,
        start_ns: int,
        since_ns: int,
        end_ns: int,
        latency_ns: int,
        is_input: Callable[[str], bool | None],
        on_start: Callable[[Roles], None],
        on_event: Callable[[], None],
        on_remark: Callable[[str, frames.Remark], None],
        most_outputs: int,
        input_class: int,
    ) -> None:
        self._peers, self._inputs, self._topics, self._outputs = peers, inputs, topics, outputs
        self._start_ns, self._end_ns, self._latency_ns = start_ns, end_ns, latency_ns
        self._services, self._actions = services, actions
        self._requests, self._since_ns = dict(requests), since_ns
        self._is_input = is_input
        self._on_start, self._on_event, self._on_remark = on_start, on_event, on_remark
        self._left = most_outputs
        self._last_ns, self._at_once = start_ns, 0
        self._input_class = input_class
        self._asked: list[RecordedRequests] = []
        self._messages: list[tuple[int, int, int, bytes]] = []  # heap of time, order, peer, frame
        self._order = 0
        self._latched: dict[str, list[tuple[Qos, RecordedInput]]] = {}
        self._targets: dict[str, Receivers] = {}  # topic → who receives its recorded messages
        self._published_topics: Counter[str] = Counter()
        self._announced: set[tuple[str, str]] = set()
        #: Topics of the recording; topics and services of the programs.
        self.named = {*topics}
        self.refused: dict[str, str] = {}
        #: Topic → recorded messages that went to programs.
        self.delivered: Counter[str] = Counter()
        #: Service or action → requests that neither a program nor the recording answers.
        self.unserved: Counter[str] = Counter()
        #: Program and topic or service → what its full queue dropped.
        self.lost: dict[tuple[str, str], Lost] = {}
        #: Session time that the programs have reached.
        self.reached_ns = start_ns
        #: Events: recorded inputs, messages and runs of deadlines.
        self.events = 0
        self.now_ns = start_ns

    # -- the order of events ------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Drive the programs to the end of the session.  Raises ProgramFault."""
        for topic in self._topics.values():
            self._announce(topic)
        for service in self._services.values():
            self._announce_service(service.name, service.type)
        for action in self._actions:
            self._announce_action(action)
        for peer in self._peers:
            self._receive(peer)
        for peer in self._peers:  # what became known since a program's own first frame
            self._flush(peer)
        self._on_start(self.roles())
        while True:
            peer = min(self._peers, key=lambda each: (each.idle.next_ns, each.idle.next_class, each.index))
            following = min((peer.idle.next_ns, peer.idle.next_class), (self._end_ns, ALL))
            if self._messages:
                following = min(following, (self._messages[0][0], MESSAGE))
            receivers: Receivers = []
            while (message := self._inputs.peek()) and (message.time_ns, self._input_class) <= following:
                if receivers := self._receivers(message):
                    break
                self._keep_latched(self._inputs.pop())
            if message and receivers:
                self.now_ns = max(self.now_ns, message.time_ns)
                if len(receivers) == 1:
                    self._advance(receivers[0][0])
                else:
                    self._deliver_to_all(self._inputs.pop(), receivers)
            elif following == (self._end_ns, ALL):
                self.reached_ns = self._end_ns
                self._look_for_sleepers()
                return
            elif self._messages and following == (self._messages[0][0], MESSAGE):
                time_ns, _, index, frame = heapq.heappop(self._messages)
                self.now_ns = max(self.now_ns, time_ns)
                if index == _OF_RECORDING:
                    self._play(frame.decode(), time_ns)
                    continue
                if index == _REQUESTED:
                    place, number = _ASKED.unpack_from(frame)
                    self._ask(self._asked[place], number, frame[_ASKED.size :], time_ns)
                    continue
                self.events += 1
                self._grant(self._peers[index], [frame], time_ns, MESSAGE)
            else:
                self.now_ns = max(self.now_ns, peer.idle.next_ns)
                self.events += 1
                self._advance(peer)

    def _look_for_sleepers(self) -> None:
        """Raise ProgramFault for a callback that sleeps long beyond the end of the session; remark another thread."""
        for peer in self._peers:
            if (left_ns := peer.idle.callback_ns - self._end_ns) > _LONGEST_SLEEP_NS:
                raise ProgramFault(
                    f"{peer.name}: a callback did not return: it sleeps at the end of the session, for "
                    f"{_long_time(left_ns)} more"
                )
            if (left_ns := peer.idle.thread_ns - self._end_ns) > _LONGEST_SLEEP_NS:
                text = f"a thread sleeps at the end of the session, for {_long_time(left_ns)} more"
                self._on_remark(peer.name, frames.Remark("l", text))

    def _bound(self, peer: Peer) -> tuple[int, int]:
        """Up to which time and class a program may go on by itself and with its inputs: before the events of others."""
        bounds = [(self._end_ns, ALL)]
        if self._messages:
            bounds.append(_before(self._messages[0][0], MESSAGE))
        for each in self._peers:
            if each is not peer and each.idle.next_ns != NEVER:
                moment = (each.idle.next_ns, each.idle.next_class)
                bounds.append(_before(*moment) if each.index < peer.index else moment)
        return min(bounds)

    def _advance(self, peer: Peer) -> None:
        """Let a program go on with its inputs, as far as no other program has an event before them."""
        bound = self._bound(peer)
        window: list[RecordedInput] = []
        sent: set[int] = set()
        content: list[bytes] = []
        size = 0
        while (message := self._inputs.peek()) and len(window) < peer.batch and size < _BATCH_BYTES:
            receivers = self._receivers(message)
            if (
                (message.time_ns, self._input_class) > bound
                or len(receivers) > 1
                or (receivers and receivers[0][0] is not peer)
            ):
                break
            window.append(self._inputs.pop())
            if receivers:
                sent.add(message.number)
                content += _message_frames(message, receivers[0][1], self._input_class)
                size += len(message.data)
        if message := self._inputs.peek():
            bound = min(bound, _before(message.time_ns, self._input_class))
        try:
            self._grant(peer, content, *bound)
        except BaseException:
            self.take_rest()
            self._count(each for each in window if each.number in sent and each.time_ns <= self.reached_ns)
            raise
        done = peer.idle.number
        used = 0
        while used < len(window) and (
            (each := window[used]).number <= done or (each.number not in sent and each.time_ns <= peer.idle.time_ns)
        ):
            used += 1
        left = window[used:]
        for message in window[:used]:
            self._keep_latched(message)
        self._count(message for message in window[:used] if message.number in sent)
        for message in reversed(left):
            self._inputs.give_back(message)
        if any(message.number in sent for message in left):
            peer.outbox.append(frames.drop())
            peer.batch = max(1, 2 * used)
        else:
            peer.batch = min(_BATCH, 2 * peer.batch)

    def _count(self, delivered: Iterable[RecordedInput]) -> None:
        for message in delivered:
            self.events += 1
            self.delivered[message.topic] += 1

    def _deliver_to_all(self, message: RecordedInput, receivers: Receivers) -> None:
        """Deliver one input to several programs, one after the other."""
        self._keep_latched(message)
        self._count([message])
        for peer, targets in receivers:
            self._grant(peer, _message_frames(message, targets, self._input_class), message.time_ns, self._input_class)

    def _keep_latched(self, message: RecordedInput) -> None:
        topic = self._topics.get(message.topic)
        if topic and topic.qos.latched:
            self._keep(message.topic, topic.qos, message)

    def _keep(self, topic: str, qos: Qos, message: RecordedInput) -> None:
        """Keep a latched message for subscriptions that come later."""
        kept = self._latched.setdefault(topic, [])
        kept.append((qos, message))
        del kept[: -max(1, qos.depth)]

    def _grant(self, peer: Peer, content: list[bytes], time_ns: int, class_: int) -> None:
        """Let a program go on, and take what it sends until it waits again."""
        self._on_event()
        peer.outbox += content
        peer.outbox.append(frames.run_to(time_ns, class_))
        self._flush(peer)
        self._receive(peer)

    # -- frames -------------------------------------------------------------------------------------------------------

    def _flush(self, peer: Peer) -> None:
        try:
            peer.link.send(b"".join(peer.outbox))
        except Gone:
            raise ProgramFault(f"{peer.name}: closed its connection", is_end=True) from None
        peer.outbox.clear()

    def _receive(self, peer: Peer) -> None:
        """Take frames of a program until it is idle."""
        try:
            while True:
                self._take(peer, frame := peer.link.receive())
                if isinstance(frame, frames.Idle):
                    return
        except Gone:
            raise ProgramFault(f"{peer.name}: closed its connection", is_end=True) from None
        except (ValueError, struct.error, IndexError) as error:
            raise ProgramFault(f"{peer.name}: found a damaged frame: {error}") from error

    def _take(self, peer: Peer, frame: frames.FromProgram) -> None:
        """Act on a frame of a program."""
        match frame:
            case frames.Published():
                self._published(peer, frame)
            case frames.Idle():
                peer.idle = frame
                self.reached_ns = max(self.reached_ns, frame.time_ns)
            case frames.Progress():
                self.reached_ns = max(self.reached_ns, frame.time_ns)
            case frames.Lost():
                self._lost(peer, frame)
            case EntityFrame():
                self._entity(peer, frame)
            case frames.Request():
                self._request(peer, frame)
            case frames.Response(program=program) if program == _RECORDING:
                return  # the client is in the recording
            case frames.Response():
                self._send(
                    frame.program,
                    frames.to_client(frame.time_ns + self._latency_ns, frame.client, frame.number, frame.data),
                    frame.time_ns,
                )
            case frames.Remark():
                self._on_remark(peer.name, frame)
            case _:
                raise ProgramFault(f"{peer.name}: found an unexpected frame {frame!r}")

    def take_rest(self) -> None:
        """Take what programs that have ended, or do not go on, have published and not sent."""
        for peer in self._peers:
            with suppress(ProgramFault, ValueError, struct.error, LookupError):
                for frame in peer.link.rest():
                    if not isinstance(frame, frames.Remark):
                        self._take(peer, frame)

    def _send(self, index: int, frame: bytes, time_ns: int) -> None:
        """Queue a frame for a program, by the time of its sending."""
        self._arrive(time_ns + self._latency_ns, index, frame)

    def _lost(self, peer: Peer, frame: frames.Lost) -> None:
        entity = peer.entities[frame.entity].frame
        depth = max(1, entity.depth)
        lost = self.lost.setdefault((peer.name, entity.name), Lost(peer.name, entity.name, depth, frame.time_ns))
        lost.count += frame.count

    def _published(self, peer: Peer, frame: frames.Published) -> None:
        publisher = peer.entities[frame.publisher]
        self.reached_ns = max(self.reached_ns, frame.time_ns)
        self._at_once = self._at_once + 1 if frame.time_ns == self._last_ns else 1
        self._last_ns = frame.time_ns
        if self._left == 0 or self._at_once > _MOST_AT_ONCE:
            most = f"{_MOST_AT_ONCE:,} at one time" if self._left else f"{self._outputs.count:,} (the limit of outputs)"
            raise ProgramFault(
                f"{peer.name}: flooded the session with messages, the last one of {publisher.frame.name}; "
                f"expected at most {most}"
            )
        self._left -= 1
        if publisher.stream is None:
            publisher.stream = self._stream(publisher)
        self._outputs.add(publisher.stream, frame.time_ns, frame.data)
        name, type_ = publisher.frame.name, publisher.frame.type
        arrival_ns = frame.time_ns + self._latency_ns
        for other in self._peers:
            targets = [
                each.frame.number
                for each in other.named("s", name)
                if other is not peer and each.frame.type == type_ and not incompatible(publisher.qos, each.qos)
            ]
            for target in targets:
                content = frames.message(0, arrival_ns, frame.time_ns, target, MESSAGE, name.encode(), frame.data)
                self._send(other.index, content, frame.time_ns)
        if publisher.frame.latched:
            message = RecordedInput(0, frame.time_ns, name, type_, frame.data, frame.time_ns, False)
            self._keep(name, publisher.qos, message)

    def _stream(self, publisher: Entity) -> OutputStream:
        frame = publisher.frame
        stream = self._outputs.streams.get(frame.name)
        if stream is None:
            stream = self._outputs.streams[frame.name] = OutputStream(frame.name, frame.type, publisher.qos)
            self._outputs.definitions.setdefault(frame.type, frame.definition)
        return stream

    def _request(self, peer: Peer, frame: frames.Request) -> None:
        name = peer.entities[frame.client].frame.name
        for other in self._peers:
            for each in other.named("v", name):
                content = frames.to_service(
                    frame.time_ns + self._latency_ns, each.frame.number, peer.index, frame.client, frame.number,
                    frame.data,
                )  # fmt: skip
                self._send(other.index, content, frame.time_ns)
                return
        named, type_ = action_of(f"{name}{SERVICE_EVENT}"), peer.entities[frame.client].frame.type
        if named and (action := self._actions.get(named[0])) and type_ == _service_types(action)[named[1]]:
            action.ask(named[1], frame.data, frame.time_ns, (peer.index, frame.client, frame.number))
            self._wake(named[0])
            return
        service = self._services.get(name)
        if service and service.type == type_ and (answer := service.take(frame.data)):
            arrival_ns = frame.time_ns + answer.latency_ns
            content = frames.to_client(arrival_ns, frame.client, frame.number, answer.data)
            self._arrive(arrival_ns, peer.index, content)
        else:
            self.unserved[name] += 1

    # -- requests of the recording ------------------------------------------------------------------------------------

    def _plan_requests(self, name: str) -> None:
        """Queue the recorded requests of a service that a program offers, once."""
        of = self._requests.pop(name, None)
        place = len(self._asked)
        for number, each in enumerate(of.exchanges if of else (), 1):
            data = of.contents.alone(each.request) if of and each.asked_ns >= max(self.now_ns, self._since_ns) else None
            if data is not None:
                self._arrive(each.asked_ns, _REQUESTED, _ASKED.pack(place, number) + data)
        if of:
            self._asked.append(of)

    def _ask(self, of: RecordedRequests, number: int, data: bytes, time_ns: int) -> None:
        """Send a recorded request, if the recording is the client of the service now."""
        if not self._is_asked(of):
            return
        for peer in self._peers:
            for each in peer.named("v", of.name):
                self.events += 1
                self.delivered[of.name] += 1
                frame = frames.to_service(time_ns, each.frame.number, _RECORDING, 0, number, data)
                self._grant(peer, [frame], time_ns, MESSAGE)
                return

    def _is_asked(self, of: RecordedRequests) -> bool:
        """Whether a program offers a service, with its type, and none calls it; or an input, which counts although."""
        types = {each.frame.type for peer in self._peers for each in peer.named("v", of.name)}
        chosen = self._is_input(f"{of.name}{SERVICE_EVENT}")
        is_called = any(peer.named("c", of.name) for peer in self._peers)
        return types == {of.type} and (not is_called if chosen is None else chosen)

    # -- actions of the recording -------------------------------------------------------------------------------------

    def _wake(self, action: str) -> None:
        """Have a recorded action send what it has to, when it has to."""
        if (next_ns := self._actions[action].next_ns) is not None:
            self._order += 1
            heapq.heappush(self._messages, (next_ns, self._order, _OF_RECORDING, action.encode()))
        if refused := self._actions[action].refused.total():
            self.unserved[action] = refused

    def _play(self, action: str, time_ns: int) -> None:
        for sent in self._actions[action].take(time_ns):
            if isinstance(sent.to, tuple):
                index, client, number = sent.to
                self._arrive(time_ns, index, frames.to_client(time_ns, client, number, sent.data))
                continue
            name = f"{action}{IN_ACTION}{sent.part}"
            type_, qos = self._topics_of(action)[name]
            for peer in self._peers:
                for each in peer.named("s", name):
                    target = each.frame.number
                    content = frames.message(0, time_ns, time_ns, target, MESSAGE, name.encode(), sent.data)
                    self._arrive(time_ns, peer.index, content)
            if qos.latched:
                self._keep(name, qos, RecordedInput(0, time_ns, name, type_, sent.data, time_ns, False))
        self._wake(action)

    def _arrive(self, time_ns: int, index: int, frame: bytes) -> None:
        """Queue a frame for a program, whose arrival is known."""
        self._order += 1
        heapq.heappush(self._messages, (time_ns, self._order, index, frame))

    def _topics_of(self, action: str) -> dict[str, tuple[str, Qos]]:
        """The topics of a recorded action: types and QoS."""
        feedback, status = f"{self._actions[action].action.type}_FeedbackMessage", "action_msgs/msg/GoalStatusArray"
        rows = ((feedback, Qos(10)), (status, Qos(1, latched=True)))
        return {f"{action}{IN_ACTION}{part}": row for part, row in zip(ACTION_TOPICS, rows, strict=True)}

    def _has_server(self, action: str) -> bool:
        """Whether a program offers an action."""
        return any(each.named("v", f"{action}{IN_ACTION}{ACTION_SERVICES[0]}") for each in self._peers)

    def _is_played(self, action: str) -> bool:
        """Whether the recording is the server of an action: a program asks for it, and none offers it."""
        goals = f"{action}{IN_ACTION}{ACTION_SERVICES[0]}"
        is_asked = action in self._actions and any(each.named("c", goals) for each in self._peers)
        return is_asked and not self._has_server(action)

    def _announce_action(self, action: str) -> None:
        for part, type_ in _service_types(self._actions[action]).items():
            self._announce_service(f"{action}{IN_ACTION}{part}", type_)
        for name, (type_, _) in self._topics_of(action).items():
            self._show("p", name, type_, not self._has_server(action))

    # -- entities -----------------------------------------------------------------------------------------------------

    def _entity(self, peer: Peer, frame: EntityFrame) -> None:
        if frame.is_made:
            peer.entities[frame.number] = Entity(frame)
            self.named.add(frame.name)
        else:
            peer.entities.pop(frame.number, None)
        self._targets.clear()
        if frame.kind == "p":
            self._published_topics[frame.name] += 1 if frame.is_made else -1
        for other in self._peers:
            if other is not peer and frame.is_ros:
                other.outbox.append(frames.elsewhere(frame.kind, frame.is_made, frame.name, frame.type))
        for each in self._peers:
            for publisher in each.named("p", frame.name) if frame.kind in "ps" else ():
                is_routed = any(other is not each and other.named("s", frame.name) for other in self._peers)
                each.outbox.append(frames.routed(publisher.frame.number, is_routed))
        topic = self._topics.get(frame.name)
        if frame.kind == "p" and topic:
            self._announce(topic)
        if frame.kind == "v" and frame.is_made:
            self._plan_requests(frame.name)
        if frame.kind == "v" and (service := self._services.get(frame.name)):
            self._announce_service(service.name, service.type)
        if frame.kind == "v" and (named := action_of(f"{frame.name}{SERVICE_EVENT}")) and named[0] in self._actions:
            self._announce_action(named[0])
        if frame.kind == "s" and frame.is_made and frame.latched:
            self._send_latched(peer, frame)

    def _announce(self, topic: RecordedTopic) -> None:
        """Have the graph of the programs show a publisher of a recorded topic exactly while the recording drives it."""
        if (named := action_of(topic.name)) and named[0] in self._actions:
            return  # shown with its action
        is_driven = topic.name.startswith("/") and self._is_recorded_input(topic)
        self._show("p", topic.name, topic.type, is_driven)

    def _announce_service(self, name: str, type_: str) -> None:
        """Have the graph of the programs show a recorded service exactly while none of them offers it."""
        self._show("v", name, type_, not any(each.named("v", name) for each in self._peers))

    def _show(self, kind: str, name: str, type_: str, is_there: bool) -> None:
        if is_there != ((kind, name) in self._announced):
            self._announced ^= {(kind, name)}
            for each in self._peers:
                each.outbox.append(frames.elsewhere(kind, is_there, name, type_))

    def _send_latched(self, peer: Peer, frame: EntityFrame) -> None:
        """What a new subscription with durability TRANSIENT_LOCAL gets at once: the last messages of latched topics."""
        kept = [message for qos, message in self._latched.get(frame.name, ()) if message.type == frame.type]
        for message in kept[-frame.depth or None :] if not frame.keeps_all else kept:
            now_ns = max(self.now_ns, peer.idle.time_ns)
            content = frames.message(
                0, now_ns, message.source_ns, frame.number, MESSAGE, message.topic.encode(), message.data
            )
            self._arrive(now_ns, peer.index, content)

    def _is_recorded_input(self, topic: RecordedTopic) -> bool:
        """Whether the recording drives a topic; by default, what programs publish themselves comes from them."""
        chosen = self._is_input(topic.name)
        if chosen is not None:
            return chosen
        if (named := action_of(topic.name)) and self._is_played(named[0]):
            return False
        return not self._published_topics[topic.name] or topic.from_gateway > 0

    def _receivers(self, message: RecordedInput) -> Receivers:
        """The programs that receive a recorded message."""
        found = self._targets.get(message.topic)
        if found is None:
            found = self._targets[message.topic] = self._find_receivers(message.topic)
        if found and not message.is_ours and self._published_topics[message.topic]:
            return found if self._is_input(message.topic) else []
        return found

    def _find_receivers(self, name: str) -> Receivers:
        topic = self._topics.get(name)
        if not topic or not self._is_recorded_input(topic):
            return []
        found = []
        for peer in self._peers:
            subscriptions = peer.named("s", name)
            taken = []
            for each in subscriptions:
                why = incompatible(topic.qos, each.qos)
                if each.frame.type != topic.type:
                    why = f"recorded as {topic.type}, expected {each.frame.type}"
                if why:
                    self.refused[name] = why
                else:
                    taken.append(each.frame.number)
            if taken:
                found.append((peer, () if len(taken) == len(subscriptions) else tuple(taken)))
        return found

    def roles(self) -> Roles:
        """What the topics are, by what the programs have made so far."""
        wanted = {each.frame.name for peer in self._peers for each in peer.entities.values() if each.frame.kind == "s"}
        given = {each.frame.name for peer in self._peers for each in peer.entities.values() if each.frame.kind == "p"}
        called = {each.frame.name for peer in self._peers for each in peer.entities.values() if each.frame.kind == "c"}
        served = {each.frame.name for peer in self._peers for each in peer.entities.values() if each.frame.kind == "v"}
        played = {name: each.action.count for name, each in sorted(self._actions.items()) if self._is_played(name)}
        of_played = {f"{name}{IN_ACTION}{part}" for name in played for part in (*ACTION_SERVICES, *ACTION_TOPICS)}
        wanted, called = wanted - of_played, called - of_played
        inputs = {name: 0 for name in sorted(wanted) if name in self._topics and self._find_receivers(name)}
        for name in inputs:
            topic = self._topics[name]
            both = self._published_topics[name] and not self._is_input(name)
            inputs[name] = topic.from_gateway + (0 if both else topic.from_others)
        return Roles(
            inputs,
            sorted(given),
            sorted(wanted & given),
            sorted(name for name in wanted - given if name not in self._topics),
            sorted(name for name in self._topics if name not in wanted | given | of_played and name != CLOCK),
            sorted(
                name
                for name in self._topics
                if name in given and self._topics[name].from_others and not self._is_input(name)
            ),
            dict(self.refused),
            {name: self._services[name].count for name in sorted(called - served) if name in self._services},
            sorted(called - served - self._services.keys()),
            played,
            {each.name: len(each.exchanges) for each in self._asked if self._is_asked(each)},
        )

    def end(self) -> None:
        """Report to all programs that the session is over."""
        for peer in self._peers:
            with suppress(Gone):
                peer.link.send(frames.end())


def _long_time(ns: int) -> str:
    return "a year and" if ns > _YEAR_NS else duration_text(ns)


def _service_types(action: PlayedAction) -> dict[str, str]:
    """The types of the services of an action."""
    type_ = action.action.type
    types = (f"{type_}_SendGoal", "action_msgs/srv/CancelGoal", f"{type_}_GetResult")
    return dict(zip(ACTION_SERVICES, types, strict=True))


def _before(time_ns: int, class_: int) -> tuple[int, int]:
    """The last moment before another one."""
    return (time_ns, class_ - 1) if class_ else (time_ns - 1, ALL)


def _message_frames(message: RecordedInput, targets: tuple[int, ...], class_: int) -> list[bytes]:
    name = message.topic.encode()
    return [
        frames.message(message.number, message.time_ns, message.source_ns, target, class_, name, message.data)
        for target in targets or (0,)
    ]
