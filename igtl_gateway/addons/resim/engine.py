"""Runs programs on a recording, several times, in session time: the interface of the add-on.

::

    result = run(Path("session.mcap"), [Program(("python", "planner.py"))], ResimOptions(runs=3), folder)
    for one in result.runs: ...    # one.outputs: a session file

``verdict.compare`` judges the runs.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from igtl_gateway.addon import (
    ConfigError,
    SystemClock,
    did_you_mean,
    matches,
    near_names,
    near_streams,
    unmatched,
    without_match,
)
from igtl_gateway.addon.processes import endings_held, make_ready
from igtl_gateway.addon.reading import PlayedAction, SessionFile, recorded_calls
from igtl_gateway.addon.terminal import counted
from igtl_gateway.addons.resim.coordinator import Coordinator, Lost, Peer, ProgramFault, Roles
from igtl_gateway.addons.resim.frames import ABI_VERSION, DEADLINE, INPUT, NEVER, Hello, Remark, welcome
from igtl_gateway.addons.resim.goals import IN_ACTION
from igtl_gateway.addons.resim.igtl_peer import (
    WEAKER,
    IgtlLink,
    IgtlRole,
    IgtlSide,
    RecordedLink,
    link_of,
    recorded_links,
)
from igtl_gateway.addons.resim.inputs import Inputs, topics_of
from igtl_gateway.addons.resim.launches import refuse_launch_file
from igtl_gateway.addons.resim.library import library_path
from igtl_gateway.addons.resim.link import Gone, Listener
from igtl_gateway.addons.resim.outputs import OF_EVERY_NODE, OutputFile, OutputStream
from igtl_gateway.addons.resim.processes import (
    ENDED_WELL,
    Process,
    apart_from,
    command_of,
    cpu_with_children_s,
    end_all,
    is_computing,
    notes,
)

#: Nothing traces the program, so it does not wait for LTTng.
_ENVIRONMENT = {"LTTNG_UST_REGISTER_TIMEOUT": "0"}
#: A process that a program has started may sleep for this real time while the program waits for it.
_CHILD_SLEEP_NS = 3_000_000_000
#: Real time that a process may take from closing its connection to its end.
_ENDING_NS = 5_000_000_000
#: After this many wall limits a program hangs, even if it computes now and then.
_MOST_LIMITS = 10
#: At most this counts of the real time between two looks: this process might have had no processor itself.
_MOST_BETWEEN_LOOKS_NS = 500_000_000
_NO_NODE = "made no ROS 2 node, or is linked statically"
_NO_LIBRARY = "uses ROS 2 without session time, as LD_PRELOAD did not reach it"
_NO_SOCKET = "made no socket, or is linked statically"
_OTHER_MIDDLEWARE = re.compile(r"librmw_(?!fastrtps|implementation|dds_common)\w+\.so")
_APART = "run each as a program of its own (--recipe)"
_OWN_SOCKET = "has a socket of its own: what it receives there comes in real time"
_GPU = re.compile(r"lib(cuda|nvcuvid|nvinfer|OpenCL|amdhip64|ze_loader)\.so")
#: Libraries of linear algebra, as numpy has one, whose threads wait by computing; variables that leave one thread.
_BLAS = re.compile(r"lib(scipy_)?(openblas|mkl|blis|gomp|iomp)")
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
#: The only middleware whose serialisation the library knows how to find.
_MIDDLEWARE = "rmw_fastrtps_cpp"


class Clocks(Enum):
    """What the clocks of libc show; those of ROS show session time always.

    SHIFTED is the default: the clocks and all sleeps and timeouts pass with session time, but the wall clock of each
    run has another offset, as if the run were on another day.  So waits work, and a result that depends on the wall
    clock, which would differ in every run of the real program, differs between the runs.
    """

    SHIFTED = "shifted"  #: session time; the wall clock with an offset for each run
    SESSION = "session"  #: session time, also ``time.time()``
    REAL = "real"  #: real time, also sleeps and timeouts: nothing happens in the session meanwhile


#: At most this is a delay of messages, or the time of the programs before the recording.
MOST_DELAY_S = 86_400
#: The wall clock of each run is later by this than that of the run before: a day and some of every smaller unit.
WALL_STEP_NS = 90_061_001_001_001


@dataclass(frozen=True, slots=True)
class Program:
    """A program to run.

    Attributes:
        command: program and arguments.
        name: for messages; default: the name of the program or of its script.
        env: added to the environment.
        folder: where it runs; None: here.
        igtl: what it is to OpenIGTLink; None: a ROS 2 program.
    """

    command: tuple[str, ...]
    name: str = ""
    env: Mapping[str, str] = field(default_factory=dict)
    folder: Path | None = None
    igtl: IgtlRole | None = None

    @property
    def title(self) -> str:
        if self.name:
            return self.name
        words = [Path(word).name for word in self.command if word[:1] != "-" and Path(word).name] or ["program"]
        if words[:2] == ["ros2", "run"]:
            return words[3 if len(words) > 3 else -1]
        return words[1] if words[0].startswith("python") and len(words) > 1 else words[0]


@dataclass(frozen=True, slots=True)
class ResimOptions:
    """How to run.

    Attributes:
        runs: how often.
        latency_ns: from the sending of a message of a program to its arrival at another one, or at itself.
        lead_ns: session time from the start of the programs to that of the recording.
        clocks: what the clocks of libc are.
        inputs: recorded topics that are inputs although a program publishes them; globs.
        outputs: recorded topics that do not drive programs; globs.
        without: topics that programs may ask for although nothing has them; globs.
        swap_ties: in every second run, timers come before recorded inputs of the same time, so that runs differ if the
            outputs depend on which of them is first.
        timers_first: they do so in every run.
        since_ns: session time at which runs begin, UTC ns; with the recording at the earliest.
        until_ns: session time at which runs end, UTC ns; at the latest they end with the recording.
        wall_s: real seconds without an event, in which no thread computes or waits for a processor, after which it
            counts as hanging.
        cpu_s: CPU seconds without an event after which a program counts as busy without end.
        most_outputs: messages that a run may have; more count as a flood.
    """

    runs: int = 3
    latency_ns: int = 0
    lead_ns: int = 0
    clocks: Clocks = Clocks.SHIFTED
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    swap_ties: bool = False
    timers_first: bool = False
    since_ns: int = 0
    until_ns: int = NEVER
    wall_s: float = 30.0
    cpu_s: float = 60.0
    most_outputs: int = 10_000_000


@dataclass(slots=True)
class Run:
    """One run.

    Attributes:
        number: from 1.
        outputs: session file with what the programs published.
        streams: its topics.
        delivered: topic → recorded messages that went to programs.
        unserved: service or action → requests that neither a program nor the recording answered.
        refused: topic → why a program did not receive it.
        lost: messages that full queues of programs have dropped, in the order of their first ones.
        named: topics of the recording, and those that programs published or asked for.
        events: number of events.
        start_ns, end_ns: session time, UTC ns; the end is where it stopped.
        remarks: what weakens the guarantee: sockets of a program, a GPU.
        hints: what would make it faster.
        seconds: real time that it took; of these `start_s` until all programs waited for the first time.
        fault: why it stopped before its end; ``""`` if it did not.
    """

    number: int
    outputs: Path
    streams: dict[str, OutputStream] = field(default_factory=dict)
    delivered: dict[str, int] = field(default_factory=dict)
    unserved: dict[str, int] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    lost: list[Lost] = field(default_factory=list)
    named: frozenset[str] = frozenset()
    events: int = 0
    start_ns: int = 0
    end_ns: int = 0
    remarks: list[str] = field(default_factory=list)
    hints: list[str] = field(default_factory=list)
    seconds: float = 0.0
    start_s: float = 0.0
    fault: str = ""

    @property
    def messages(self) -> int:
        """What the programs published, without the topics of every node."""
        return sum(stream.messages for name, stream in self.streams.items() if name not in OF_EVERY_NODE)


@dataclass(slots=True)
class RunResult:
    """All runs of one recording.

    Attributes:
        recording: the recording.
        roles: what the topics are, as of the first run; None if it did not come that far.
        runs: in order; the last one has a fault if a program is at fault, and then there are fewer than requested.
        links: of OpenIGTLink, whose peers the programs replaced.
        window: session time of the runs, UTC ns: from the first one on, up to the second one.
        zero_ns: start of the recording, from which times are counted; 0: that of the runs.
    """

    recording: Path
    roles: Roles | None = None
    runs: list[Run] = field(default_factory=list)
    links: frozenset[int] = frozenset()
    window: tuple[int, int] = (0, NEVER)
    zero_ns: int = 0

    @property
    def fault(self) -> str:
        return self.runs[-1].fault if self.runs else ""


def run(
    recording: Path,
    programs: Sequence[Program],
    options: ResimOptions,
    folder: Path,
    *,
    on_roles: Callable[[Roles], None] = lambda roles: None,
    on_run: Callable[[Run], None] = lambda run: None,
) -> RunResult:
    """Run programs on a recording.

    Args:
        recording: a session, or an MCAP file of rosbag2.
        programs: the programs; their order is the order of ties.
        options: how.
        folder: where the outputs go, as ``run-1.mcap`` …
        on_roles: called before the first event of the first run, with what is input and what output.
        on_run: called after each run.

    Raises:
        ConfigError: nothing to run, another middleware, an invalid folder, or inputs that are not recorded.
        Unavailable: the library is not built on this machine.
        RecordingError: the recording cannot be read.
        KeyboardInterrupt: Ctrl-C; the programs have ended, and the files of outputs are closed.
    """
    if not programs or not all(program.command for program in programs):
        raise ConfigError("found no program, expected one behind --")
    if options.runs < 1:
        raise ConfigError(f"runs: found {options.runs}, expected 1 or more")
    for program in programs:
        middleware = {**os.environ, **program.env}.get("RMW_IMPLEMENTATION") or _MIDDLEWARE
        if middleware != _MIDDLEWARE and not program.igtl:
            raise ConfigError(f"{program.title}: found RMW_IMPLEMENTATION={middleware}, expected {_MIDDLEWARE}")
    for program in programs:
        refuse_launch_file(program.command, program.title)
    library = library_path()
    if not all(program.igtl for program in programs):
        make_ready()  # else a program would compile during the session
    replaced: dict[int, RecordedLink] = {}
    if any(program.igtl for program in programs):
        if options.clocks is Clocks.REAL:
            raise ConfigError("found real clocks and an OpenIGTLink program, expected clocks with session time")
        with SessionFile.open(recording) as file:
            recorded = recorded_links(file)
        replaced = {
            index: link_of(program.igtl, recorded, program.title)
            for index, program in enumerate(programs)
            if program.igtl
        }
    _check_links(programs, replaced)
    _check_topics(recording, replaced, options)
    result = RunResult(recording, links=frozenset(each.number for each in replaced.values()))
    if options.since_ns:
        with SessionFile.open(recording) as file:
            result.zero_ns = file.start_ns
    result.window = options.since_ns, min(options.until_ns, NEVER - 1) + 1
    for number in range(1, options.runs + 1):

        def take(roles: Roles) -> None:
            if result.roles is None:
                result.roles = roles
                on_roles(roles)

        one = Run(number, run_file(folder, number))
        result.runs.append(one)
        _run_once(recording, programs, replaced, options, library, one, take)
        if number == 1 and not one.fault:
            one.fault = _matches_nothing(one, options)
        on_run(one)
        if one.fault:
            break
    return result


def _check_links(programs: Sequence[Program], replaced: Mapping[int, RecordedLink]) -> None:
    """Raise ConfigError if two programs replace the peer of one link: each would get its messages."""
    first: dict[int, int] = {}
    for index, link in replaced.items():
        other = first.setdefault(link.number, index)
        if other != index:
            whose = f"{programs[other].title} (program {other + 1})"
            raise ConfigError(
                f"{programs[index].title} (program {index + 1}): found link {link.number}, which {whose} has, "
                "expected another link"
            )


def _check_topics(recording: Path, replaced: Mapping[int, RecordedLink], options: ResimOptions) -> None:
    """Raise ConfigError if one of the inputs matches no recorded topic, or one of the outputs only nearly one.

    Nothing would drive the input, and the option would have no effect on an output that only programs have.
    """
    if not options.inputs and not options.outputs:
        return
    with SessionFile.open(recording) as file:
        names = {*topics_of(file), *(name for each in replaced.values() for name in each.topics())}
    without = without_match(options.inputs, names)
    wrong = [f"--input {glob}: {unmatched(glob, names, 'recorded topic')}" for glob in without]
    names |= {*OF_EVERY_NODE, *(name.partition(IN_ACTION)[0] for name in names)}
    wrong += [
        f"--output {glob}: {unmatched(glob, names, 'topic of the recording')}"
        for glob in without_match(options.outputs, names)
        if near_streams(glob, names)
    ]
    if wrong:
        raise ConfigError("; ".join(wrong))


def _matches_nothing(one: Run, options: ResimOptions) -> str:
    """What is wrong with topics to run without that nothing has had in a run; ``""`` for nothing."""
    names = {*one.named, *(name.partition(IN_ACTION)[0] for name in one.named), *OF_EVERY_NODE}
    what = "topic of the recording or of a program"
    return "; ".join(
        f"--without {glob}: {unmatched(glob, names, what)}" for glob in without_match(options.without, names)
    )


def _unknown_outputs(roles: Roles, options: ResimOptions) -> str:
    """What is wrong with outputs that neither the recording nor a program has at its start; ``""`` for nothing.

    The option has no effect on a topic that only a program has: one that comes later is an output without it.
    """
    names = {*roles.inputs, *roles.outputs, *roles.between, *roles.missing, *roles.unused, *roles.refused}
    names |= {*OF_EVERY_NODE, *(name.partition(IN_ACTION)[0] for name in names)}
    what = "topic of the recording or of a program at its start"
    return "; ".join(
        f"--output {glob}: {unmatched(glob, names, what)}" for glob in without_match(options.outputs, names)
    )


def run_file(folder: Path, number: int) -> Path:
    """Where the outputs of a run go."""
    return folder / f"run-{number}.mcap"


def _run_once(
    recording: Path,
    programs: Sequence[Program],
    replaced: Mapping[int, RecordedLink],
    options: ResimOptions,
    library: Path,
    one: Run,
    on_roles: Callable[[Roles], None],
) -> None:
    clock = SystemClock()
    began_ns = clock.monotonic_ns()

    def started(roles: Roles) -> None:
        one.start_s = (clock.monotonic_ns() - began_ns) / 1e9
        on_roles(roles)
        if why := _unknown_outputs(roles, options):
            raise ProgramFault(why)
        if why := _not_received(roles, options):
            raise ProgramFault(f"{why}; --without TOPIC runs the programs without it")

    with ExitStack() as stack:
        look_for_signals = stack.enter_context(endings_held())
        file = stack.enter_context(SessionFile.open(recording))
        outputs = OutputFile(one.outputs, recording.name, overwrite=True)
        stack.callback(outputs.close)
        one.start_ns, one.end_ns = max(file.start_ns, options.since_ns), min(file.end_ns, options.until_ns)
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="igtl-resim-")))
        listener = Listener(place)
        stack.callback(listener.close)
        processes: list[Process] = []
        stack.callback(end_all, processes, listener.path)
        watch = _Watch(processes, listener, clock, options, library, look_for_signals)
        joining = _Joining(stack, watch, processes, listener, library, replaced, options, one)
        coordinator: Coordinator | None = None
        try:
            calls = recorded_calls(file)
            peers = [joining.join(index, program) for index, program in enumerate(programs)]
            coordinator = Coordinator(
                peers,
                Inputs(file, {each.number for each in replaced.values()}, options.since_ns),
                topics_of(file) | {name: topic for each in replaced.values() for name, topic in each.topics().items()},
                calls.services,
                {name: PlayedAction(action) for name, action in calls.actions.items()},
                calls.requests,
                outputs,
                start_ns=joining.begin_ns,
                since_ns=options.since_ns,
                end_ns=one.end_ns,
                latency_ns=options.latency_ns,
                is_input=lambda topic: _chosen(topic, options),
                on_start=started,
                on_event=watch.begin,
                on_remark=watch.take,
                most_outputs=options.most_outputs,
                input_class=DEADLINE if joining.is_swapped else INPUT,
            )
            coordinator.run()
            watch.look_at_libraries()
            one.hints = faster(processes)
            watch.await_others()
        except (ProgramFault, Gone) as fault:
            one.fault = _text_of(fault, watch, one)
        finally:
            if coordinator:
                coordinator.take_rest()
            if one.fault:
                one.end_ns = max(one.start_ns, coordinator.reached_ns if coordinator else 0)
            if coordinator:
                coordinator.end()
                _take_results(one, coordinator)
            one.remarks = sorted(watch.remarks)
            outputs.close()
            one.streams = outputs.streams
            one.seconds = (clock.monotonic_ns() - began_ns) / 1e9


def _text_of(fault: ProgramFault | Gone, watch: _Watch, one: Run) -> str:
    """What ended a run, as one line."""
    text = str(fault)
    if isinstance(fault, Gone) or fault.is_end:
        text = watch.ended(wait=True) or watch.replaced() or text or "a program closed its connection"
    if not one.start_s and text.endswith(ENDED_WELL):
        text += " before the session began: does it spin?"
    return text


def _take_results(one: Run, coordinator: Coordinator) -> None:
    one.lost = sorted(coordinator.lost.values(), key=lambda each: each.first_ns)
    one.delivered, one.unserved = dict(coordinator.delivered), dict(coordinator.unserved)
    one.refused, one.events = dict(coordinator.refused), coordinator.events
    one.named = frozenset(coordinator.named)


@dataclass(frozen=True)
class _Joining:
    """How the programs of a run are started and connected, one after the other; ``stack`` ends what they leave."""

    stack: ExitStack
    watch: _Watch
    processes: list[Process]
    listener: Listener
    library: Path
    replaced: Mapping[int, RecordedLink]
    options: ResimOptions
    one: Run

    @property
    def begin_ns(self) -> int:
        """When the programs begin, session time."""
        return self.one.start_ns - self.options.lead_ns

    @property
    def is_swapped(self) -> bool:
        """Whether timers come before messages at equal times."""
        return self.options.timers_first or (self.options.swap_ties and self.one.number % 2 == 0)

    def join(self, index: int, program: Program) -> Peer:
        """Start a program, and wait until it has connected.

        Raises ProgramFault or Gone.
        """
        env = {**os.environ, **program.env, "IGTL_GATEWAY_RESIM": str(self.listener.path), **_ENVIRONMENT}
        env["LD_PRELOAD"] = " ".join(filter(None, [str(self.library), env.get("LD_PRELOAD", "")]))
        side = IgtlSide(program.igtl, program.title) if program.igtl else None
        command = program.command
        if side:
            self.stack.callback(side.close)
            env |= side.environment
            command = side.command(command)
        watch = self.watch
        process = Process(program.title, command, env, program.folder)
        self.processes.append(process)
        watch.begin()
        watch.is_joining = True
        watch.side = side
        link = self.listener.accept(watch.look)
        self.stack.callback(link.close)
        hello = link.receive()
        if not isinstance(hello, Hello) or hello.abi != ABI_VERSION:
            version = hello.abi if isinstance(hello, Hello) else "unknown"
            wrong = f"found {self.library.name} of version {version}, expected {ABI_VERSION}"
            raise ProgramFault(f"resim: {wrong}: install igtl-gateway again, which compiles it")
        watch.check_family(hello.pid)
        process.joined(hello.pid)
        watch.is_joining = False
        is_shifted = self.options.clocks is Clocks.SHIFTED and not side
        link.send(
            welcome(
                self.begin_ns,
                self.options.latency_ns,
                (self.one.number - 1) * WALL_STEP_NS if is_shifted else 0,
                index,
                is_real=self.options.clocks is Clocks.REAL,
                deadline_class=INPUT if self.is_swapped else DEADLINE,
            )
        )
        if not side:
            return Peer(index, program.title, link)
        watch.remarks.add(f"{program.title}: {WEAKER}")
        igtl = IgtlLink(program.title, side, link, self.replaced[index], self.begin_ns, watch.take)
        self.stack.callback(igtl.close)
        return Peer(index, program.title, igtl)


def _not_received(roles: Roles, options: ResimOptions) -> str:
    """What programs ask for and do not get, and why; ``""`` for nothing, or what they may run without."""
    wrong: dict[str, dict[str, None]] = {}
    for name in roles.missing:
        action, is_action, _ = name.partition(IN_ACTION)
        question = did_you_mean(near_names(name, roles.unused))
        absent = "asked for, but the recording has no such topic" + f": {question}" * bool(question)
        why = "no program is its server" if is_action else absent
        if not (_may_miss(name, options) or _may_miss(action, options)):
            wrong.setdefault(why, {})[f"action {action}" if is_action else name] = None
    for name, why in roles.refused.items():
        if name not in roles.inputs and not _may_miss(name, options):
            wrong.setdefault(f"not received: {why}", {})[name] = None
    return "; ".join(f"{', '.join(names)}: {why}" for why, names in wrong.items())


def faster(processes: Sequence[Process]) -> list[str]:
    """Return what would make programs faster: each of their threads has to rest before session time passes."""
    found = []
    for each in processes:
        library = next((name for name in sorted(each.libraries()) if _BLAS.match(name)), "")
        threads = each.computing_threads()
        if library and threads > 1 and not any(each.env.get(name) == "1" for name in _ONE_THREAD):
            found.append(
                f"{each.name}: {counted(threads, 'thread')} compute ({library.partition('-')[0].partition('.so')[0]}); "
                f"{_ONE_THREAD[0]}=1 before the command, or in env of a recipe, may be several times faster"
            )
    return found


def _second(pid: int) -> str:
    """What is wrong with a second process of a program that takes part."""
    return f"started another process that takes part: {command_of(pid)}; {_APART}"


def _may_miss(topic: str, options: ResimOptions) -> bool:
    return any(matches(glob, topic) for glob in options.without)


def _chosen(topic: str, options: ResimOptions) -> bool | None:
    if any(matches(glob, topic) for glob in options.inputs):
        return True
    return False if any(matches(glob, topic) for glob in options.outputs) else None


class _Watch:
    """Looks after the processes while they are waited for: whether they run, and what time they use."""

    def __init__(
        self,
        processes: list[Process],
        listener: Listener,
        clock: SystemClock,
        options: ResimOptions,
        library: Path,
        look_for_signals: Callable[[], None],
    ) -> None:
        self._processes, self._listener, self._clock, self._options = processes, listener, clock, options
        self._library = library.name
        self._look_for_signals = look_for_signals
        self._looked_ns = self._waited_ns = self._idle_ns = 0
        self._cpu_s: dict[int, float] = {}
        # since when the program waits for other processes, when it was seen, how long they slept; their CPU time before
        self._helped_ns = self._seen_ns = self._asleep_ns = 0
        self._helper_s: dict[int, float] = {}
        #: Whether the last process is expected to connect.
        self.is_joining = False
        #: Of an OpenIGTLink program that is expected to connect.
        self.side: IgtlSide | None = None
        #: What weakens the guarantee.
        self.remarks: set[str] = set()

    def begin(self) -> None:
        """An event happened: the time of the next one begins.  Raises KeyboardInterrupt after Ctrl-C."""
        self._looked_ns = self._helped_ns = self._asleep_ns = 0
        self._look_for_signals()

    def take(self, name: str, remark: Remark) -> None:
        """Take a remark of a program with this name."""
        if remark.code in "cz":
            self._wait_for(name, int(remark.text), is_asleep=remark.code == "z")
        elif remark.code == "s":
            self.remarks.add(f"{name}: {_OWN_SOCKET}")
        elif remark.code == "l":
            self.remarks.add(f"{name}: {remark.text}")
        elif remark.code == "t":
            self.remarks.add(f"{name}: sets a timer by {remark.text}, which runs in real time")
        elif remark.code == "h":
            pid, _, call = remark.text.partition(" ")
            if command := command_of(int(pid)):
                self.remarks.add(f"{name}: process {command!r} waits by {call}, whose timeout passes in real time")
        elif remark.code == "w":
            call, _, thread = remark.text.partition(" ")
            self.remarks.add(f"{name}: thread {thread!r} waits by {call}, whose timeout passes in real time")

    def look_at_libraries(self) -> None:
        """Note what programs have loaded.  Raises ProgramFault for another middleware."""
        for each in self._processes:
            for name in sorted(each.libraries()):
                if _OTHER_MIDDLEWARE.match(name):
                    raise ProgramFault(f"{each.name}: found {name}, expected {_MIDDLEWARE}")
                if _GPU.match(name):
                    self.remarks.add(f"{each.name}: has loaded {name}: what a GPU computes may differ from run to run")

    def check_family(self, pid: int) -> None:
        """Raise ProgramFault if a process that has joined comes from a program that takes part already."""
        for each in self._processes[:-1]:
            if pid in each.family():
                raise ProgramFault(f"{each.name}: {_second(pid)}")

    def await_others(self) -> None:
        """Wait for the end of the processes that programs have started, and that run apart from them.

        Raises:
            ProgramFault: one of them neither computes nor ends, or takes part in ROS.
        """
        place = self._listener.path
        ros = {each.pid for each in self._processes}
        self._look_for_strangers()
        for note in notes(place):
            if note.what == "u":
                raise ProgramFault(f"{self._any_name}: forked, and the copy uses ROS 2 ({note.text}); {_APART}")
            if note.what == "s" and note.pid not in ros:
                self.remarks.add(
                    f"{self._any_name}: another process, {command_of(note.pid) or 'which has ended'}, {_OWN_SOCKET}"
                )
        self.begin()
        while others := apart_from(self._processes, place):
            self._look_for_signals()
            for pid in others:
                self._wait_for(self._any_name, pid, is_asleep=not is_computing(pid))
            self._processes[0].wait(0.02)

    @property
    def _any_name(self) -> str:
        names = {each.name for each in self._processes}
        return names.pop() if len(names) == 1 else "a program"

    def _look_for_strangers(self) -> None:
        """Raise ProgramFault if a second process of a program has joined."""
        if pid := self._listener.stranger():
            name = next((each.name for each in self._processes if pid in each.family()), self._any_name)
            raise ProgramFault(f"{name}: {_second(pid)}")

    def _wait_for(self, program: str, pid: int, *, is_asleep: bool) -> None:
        """A program does not come to rest because of another process.  Raises ProgramFault if that takes too long."""
        now_ns, options = self._clock.monotonic_ns(), self._options
        cpu_s = cpu_with_children_s(pid)
        if not self._helped_ns:
            self._helped_ns = self._seen_ns = now_ns
            self._helper_s.clear()
        if is_asleep and not any(each.is_computing() for each in self._processes):
            self._asleep_ns += min(now_ns - self._seen_ns, _MOST_BETWEEN_LOOKS_NS)
        else:
            self._waited_ns = self._idle_ns = 0  # the program waits for it
        self._seen_ns = now_ns
        is_late = self._asleep_ns > max(min(_CHILD_SLEEP_NS, options.wall_s * 1e9), (now_ns - self._helped_ns) // 2)
        is_busy = cpu_s - self._helper_s.setdefault(pid, cpu_s) > options.cpu_s
        if is_late or is_busy:
            command = command_of(pid) or "a process"
            raise ProgramFault(
                f"{program}: started another process, which still runs: {command}; {_APART}, or not at all"
            )

    def look(self, *, is_flowing: bool = False) -> None:
        """Raise ProgramFault if a process has ended, hangs, or is busy; KeyboardInterrupt after Ctrl-C.

        ``is_flowing``: a program sends so much that it waits for this process.
        """
        self._look_for_signals()
        options = self._options
        now_ns = self._clock.monotonic_ns()
        if not self._looked_ns:
            self._looked_ns, self._waited_ns, self._idle_ns = now_ns, 0, 0
            self._cpu_s = {each.pid: each.cpu_s() for each in self._processes}
        absent = _NO_SOCKET if self.side else _NO_NODE
        if not is_flowing and (ended := self.ended()):  # else the rest of its messages first
            is_absent = self.is_joining and not any(each.has_failed for each in self._processes)
            raise ProgramFault(f"{ended}; {absent}" if is_absent else ended)
        if self.is_joining and self.side:
            self.side.look()
        elif self.is_joining and (alone := self._processes[-1].without(self._library)):
            raise ProgramFault(f"{self._processes[-1].name}: {_NO_LIBRARY}: {command_of(alone)}")
        if not self.is_joining:
            self._look_for_strangers()
        passed_ns = min(now_ns - self._looked_ns, _MOST_BETWEEN_LOOKS_NS)
        self._looked_ns = now_ns
        self._waited_ns += passed_ns
        self._idle_ns += 0 if any(each.is_computing() for each in self._processes) else passed_ns
        if is_flowing:
            self._waited_ns = self._idle_ns = 0
        used = {each: each.cpu_s() - self._cpu_s.get(each.pid, 0.0) for each in self._processes}
        busy = max(used, key=lambda each: used[each], default=None)
        if busy is None:
            return
        what = absent if self.is_joining else "did not come to rest"
        if used[busy] > options.cpu_s:
            thread = busy.busiest()
            raise ProgramFault(
                f"{busy.name}: {what} within {options.cpu_s:g} s of CPU time (the CPU limit): "
                f"thread {thread.name!r} is busy"
            )
        if max(self._idle_ns, self._waited_ns / _MOST_LIMITS) > options.wall_s * 1e9:
            name = self._processes[-1].name if self.is_joining else busy.name
            is_idle = self._idle_ns > options.wall_s * 1e9
            limit = "the wall limit" if is_idle else f"{_MOST_LIMITS} wall limits, as it computes"
            seconds = options.wall_s if is_idle else _MOST_LIMITS * options.wall_s
            raise ProgramFault(f"{name}: {what} within {seconds:g} s ({limit})")

    def replaced(self) -> str:
        """Which process runs another program now; ``""`` for none."""
        for each in self._processes:
            if each.is_running and each.is_replaced:
                return f"{each.name}: replaced itself by another program (exec): {command_of(each.pid)}; {_APART}"
        return ""

    def ended(self, *, wait: bool = False) -> str:
        """Which process has ended, and how; ``""`` for none.  ``wait``: one of them is about to end."""
        until_ns = self._clock.monotonic_ns() + (_ENDING_NS if wait else 0)
        while True:
            for each in self._processes:
                if not each.is_running:
                    return f"{each.name}: {each.exit_text()}"
            if self._clock.monotonic_ns() >= until_ns:
                return ""
            self._processes[0].wait(0.02)
