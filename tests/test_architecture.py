"""The import levels and the homes of outside libraries, as tables that every module is checked against.

Checked on the syntax tree, so imports inside functions and under ``TYPE_CHECKING`` count like any other,
and no module has to be importable.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from igtl_gateway import addon
from igtl_gateway.addon.loading import home_of
from tests.conftest import LONGEST
from tests.tables import table

PACKAGE = "igtl_gateway"
LABORATORY = "igtl_gateway_lab"
TESTS = Path(__file__).parent
ROOT = TESTS.parent

#: Distribution → its folder.  The modules of the laboratory have names that start with ``lab``.
FOLDERS = {PACKAGE: ROOT / PACKAGE, LABORATORY: ROOT / "lab" / LABORATORY}
LAB = "lab"

#: The package itself, ``igtl_gateway/__init__.py``: its version, for everybody, and the names of the API.
TOP = ""

#: Unit → level, as `farm-studio look` and ARCHITECTURE.md count: a folder stands above all that it imports, the ground
#: is 1.  A module belongs to the longest unit that it lies in; names are relative to the package.
LEVELS = {
    TOP: 1,
    "base": 1,  # what everything stands on
    "native": 1,  # the parts in C of the core
    "wire": 2,
    "gateway.log": 2,  # the session log
    "convert": 3,
    "config": 4,
    "gateway": 5,
    "edges": 6,  # the helpers that its edges share
    "edges.ros": 6,
    "edges.ros_interfaces": 6,
    "edges.tcp": 6,
    "edges.tcp.http_server": 6,  # for counts and pages
    "edges.video": 6,
    "record": 6,
    "doctor": 6,
    "replay": 7,
    "app": 8,
    "api": 9,
    "cli": 9,
    "testing": 9,
    "addon": 10,  # the surface for add-ons
    "addons": 11,
    "start": 10,  # the entry point, which imports nothing early
    "__main__": 11,
    "lab": 1,
    "lab.simulate": 6,
    "lab.programs": 8,
    "lab.bench": 9,
    "lab.stage": 9,
    "lab.verbs": 11,
    "lab.cli": 11,
    "lab.demo": 11,
    "lab.bench.__main__": 11,
}

#: What an add-on reaches the core by, beside the package itself.
DOOR = "addon"
#: Add-on → modules of other add-ons that it uses where they are installed; below ``addons``.
NEIGHBOURS = {
    "cohort": ("review", "review.choices", "review.recorded", "sync.lag", "sync.lags"),
    "lerobot": ("exchange.source", "sync.lag", "sync.lags", "sync.signal"),
    "merge": ("sync.lag", "sync.lags", "sync.verb_run"),
    "view": ("review", "sync.curves", "sync.lag", "sync.lags", "sync.signal", "sync.verb_run"),
}

#: Programs that play foreign software: of our modules they may use only their own, of outside libraries any.
STRANGERS = ("lab.demo",)

#: Unit → another unit that it may use although its level is not lower.
SIBLINGS: dict[str, str | tuple[str, ...]] = {
    TOP: ("api", "addons", "base"),  # the public names, imported at their first use; the version
    "edges.ros": "edges.ros_interfaces",  # what has to be compiled before a node starts
    "lab.bench": "addons",  # a measuring program that speaks Zenoh
}

#: What makes code of ROS definitions.
GENERATORS = (
    "rosidl_adapter",
    "rosidl_generator_c",
    "rosidl_generator_py",
    "rosidl_generator_type_description",
    "rosidl_parser",
    "rosidl_pycommon",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
)

#: Modules and libraries that only some units may use.  What is neither here nor in the standard library
#: is refused everywhere: give it a home first.
HOMES: dict[str, tuple[str, ...]] = {
    # The live world
    "asyncio": ("api.aio",),
    "select": ("edges.tcp.lobby", "edges.tcp.sender"),
    "selectors": ("edges.tcp.loop",),
    # What not every system has
    "fcntl": (
        "base.systems.files",
        "edges.tcp.sockets",  # what a peer has not confirmed, of Linux
    ),
    "termios": ("cli.keys",),
    "msvcrt": ("cli.keys", "base.systems.files"),
    "resource": ("base.realtime", "base.systems.processes"),
    **dict.fromkeys(("grp", "posix", "pty", "pwd", "syslog", "tty", "winreg", "_winapi"), ()),
    "socket": (
        "edges.tcp",
        "edges.reserved",
        "base.systems.signals",
        "base.systems.service",  # to the service manager
        "addons.resim.link",  # to the library in a program
        "addons.resim.igtl_peer",  # to an OpenIGTLink program
        "addons.resim.tcp_state",  # what of it has arrived
        "lab.bench",
    ),  # a measurement has a peer that costs nothing, and a port for any bridge
    "socketserver": (),
    "ssl": ("edges.tcp.tls",),
    "http": (
        "edges.tcp.http_server",
        "edges.tcp.websocket",
        "addons.upload.s3",
        "addons.page.server",
        "addons.page.source",
    ),
    "rclpy": ("edges.ros.middleware",),
    # Time and chance: the core is a pure function of its inputs
    "time": ("base.clock",),
    "random": ("lab.simulate",),
    "secrets": (),
    "uuid": (),
    # Libraries
    "av": ("edges.video",),
    "cryptography": ("record.seal.keys", "record.seal.time_stamps"),
    "dask": ("addons.cohort.scheduler",),
    "duckdb": ("addons.cohort.query",),
    "blake3": ("record.seal.digest",),
    "rfc3161_client": ("record.seal.time_stamps",),
    "fastcrc": ("wire", "record.sessionfile"),
    "lz4": ("record.sessionfile.compression", "base.untrusted.unpack"),
    "pyigtl": ("lab.bench.pyigtl_side",),  # a peer of another project
    "mcap": ("addons.exchange", "addons.merge.writer", "record.sessionfile"),
    "obstore": ("addons.cohort.objects",),
    "torch": ("addons.lerobot.torch_set",),
    "nibabel": ("addons.exchange.nifti", "lab.simulate.volume"),
    "matplotlib": ("lab.bench.plot", "addons.sync.plot"),
    "pandas": ("api",),
    "pyarrow": (
        "api",
        "api.arrow_tables",
        "addons.exchange.arrow_names",
        "addons.exchange.arrow_out",
        "base.untrusted.parquet_file",
        "addons.lerobot",
        "addons.cohort",
        "addons.view.arrays",
        "addons.view.chosen",
        "addons.view.columns",
    ),
    "pcapng": ("addons.exchange.pcap_file",),
    "h5py": ("addons.lerobot.hdf5_process",),
    "numpy": (
        "base.untrusted.parquet_file",
        "wire",
        "convert",
        "doctor",
        "gateway",
        "edges",
        "record",
        "replay",
        "api",
        "cli",
        "addons",
        "lab",
    ),
    "pytest": ("testing.plugin",),
    "wsproto": ("edges.tcp.websocket",),
    "rerun": ("addons.view",),
    **dict.fromkeys(GENERATORS, ("edges.ros_interfaces.build",)),
    "rosbags": (
        "addons.deidentify.ros",
        "addons.exchange",
        "api.columns",
        "api.cdr_columns",
        "replay",
        "record.sessionfile.header_stamps",
        "record.sessionfile.recovery",
        "record.sessionfile.schemas",
        "base.untrusted",
    ),
    "ruamel": ("base.untrusted.yaml_text",),  # brought by rosbags, as zstandard is by mcap
    "xxhash": ("addons.zenoh.library",),
    "zenoh": ("addons.zenoh.library",),
    "shtab": ("cli.completion",),
    "tomli": ("base.versions",),
    "typing_extensions": ("base.versions",),
    "zstandard": ("record.sessionfile.compression", "base.untrusted.unpack"),
}

#: What the levels up to the gateway may not use, on top: the environment, other threads, other processes.
IMPURE = frozenset({"ctypes", "multiprocessing", "os", "signal", "subprocess", "threading"})
HIGHEST_PURE_LEVEL = 5
#: What Linux, macOS and Windows do differently.
SYSTEM = "base.systems"
#: Who does that below, for all others: the system, programs in processes of their own, priority and memory of threads.
BELOW = (SYSTEM, "base.child", "base.realtime")

#: What Windows does not have, of modules that it has, and who uses it: where it is not needed, or only on Linux.
ABSENT: dict[str, frozenset[str]] = {
    "os": frozenset(
        "O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK chown chroot eventfd fchmod fchown fork forkpty getegid geteuid "
        "getgid getloadavg getpgid getpgrp getsid getuid killpg lchown major memfd_create minor mkfifo mknod nice "
        "pipe2 posix_fadvise posix_fallocate posix_spawn pread preadv pwrite pwritev readv sched_getaffinity "
        "sched_param sched_setaffinity sched_setscheduler sendfile setpgid setsid splice statvfs sync sysconf "
        "tcgetpgrp tcsetpgrp uname wait wait3 wait4 WNOHANG writev".split()
    ),
    "signal": frozenset(
        "SIGALRM SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGTSTP SIGUSR1 SIGUSR2 alarm pause "
        "pthread_kill pthread_sigmask setitimer sigtimedwait sigwait".split()
    ),
    "socket": frozenset("AF_UNIX CMSG_LEN SCM_RIGHTS SO_PEERCRED SO_REUSEPORT TCP_INFO recv_fds send_fds".split()),
    "select": frozenset("epoll kqueue poll POLLIN POLLOUT".split()),
    "mmap": frozenset("MAP_PRIVATE MAP_SHARED PROT_READ PROT_WRITE".split()),
    "time": frozenset("CLOCK_BOOTTIME CLOCK_MONOTONIC CLOCK_REALTIME clock_gettime clock_gettime_ns tzset".split()),
}
ABSENT_HOMES: dict[str, tuple[str, ...]] = {
    "os": (SYSTEM, "cli.keys", "edges.ros.env", "edges.ros_interfaces.build", "base.realtime", "record.shared_queue"),
    "signal": (SYSTEM, "edges.ros_interfaces.build"),
    "socket": ("edges.tcp.sockets", "base.systems.service", "addons.resim.link"),
    "select": ("edges.tcp.lobby", "edges.tcp.sender"),
}

#: Who may choose a module's name at run time: message types from the graph, verbs from the command line; and the
#: package itself, the names of the API.
DYNAMIC_IMPORTERS = ("edges.ros.middleware", "cli", "base.addons", "addon")

#: Who may print or write to the standard streams: whatever else prints does it by ``cli.terminal``, which escapes.
PRINTERS = ("cli.terminal",)
#: Programs that report to our own process what they do, and the progress of a compiler, also in programs of others.
STREAM_WRITERS = (*PRINTERS, "lab.bench.programs", "edges.ros_interfaces.__main__", "edges.ros_interfaces.progress")
CLOCK_CALLS = frozenset({"now", "today", "utcnow"})

#: Tests of no single module, relative to the folder of tests; a folder stands for all that is in it.
UNMIRRORED = (
    "record/test_full_disk.py",  # writer, output and worker
    "record/test_memory_order.py",  # shared_queue.py and kernel/_queue.h on ARM
    "convert/test_distributions.py",  # definitions of ROS 2 distributions
    "replay/test_versions.py",  # recordings of all versions
    "record/test_ring_model.py",  # shared_queue.py against a model
    "record/test_node_reader.py",  # our files in a reader of another language
    "test_costs.py",  # all stages of a message
    "test_mistyped_names.py",  # all verbs
    "addons/view/test_plus.py",  # what PLUS sends, drawn
    "integration",
    "peers",
    "native/test_foreign.py",  # the native passage, on foreign bytes
    "native/test_kernel.py",  # the headers of native/kernel, in C
    "native/test_memory.py",  # native/passage without memory
    "native/test_rooms.py",  # the headers of native/kernel and native/passage
    "native/test_states.py",  # native/passage/STATES.md
    "native/test_subscriptions.py",  # native/passage/_taking.h
    "native/test_turns.py",  # turns of links, native/passage/_turns.h
    "native/test_twins.py",  # rules that stand in Python and in C
    "native/test_types.py",  # the types of native/passage/python
    "addons/resim/test_abi.py",  # addons/resim/preload/_abi.h
    "addons/resim/test_programs.py",  # programs of every kind, 5 runs each
    "addons/resim/test_page.py",  # docs/how-to/resim.md
    "addons/resim/test_regressions.py",  # planted in a planner
    "addons/resim/test_quiet.py",  # programs that do less than they did
    "addons/resim/test_queues.py",  # programs that are slower than their input
    "addons/resim/test_faults.py",  # programs that do what they should not
    "addons/exchange/test_import_memory.py",  # any importer
    "addons/exchange/test_import_mutations.py",  # tools/import_mutations.py
    "cli/test_file_modes.py",  # outputs of every verb
    "cli/test_exit_codes.py",  # every verb's, docs/reference/command-line.md
    "cli/test_main.py",  # the verbs' common entry, cli/__init__.py
    "cli/test_start.py",  # what every verb imports
    "addons/test_absent.py",  # base/addons.py, and what each add-on needs
    "test_architecture.py",
    "test_try_extras.py",  # tools/try_extras.py
    "test_try_install.py",  # tools/try_install.py, deploy/conda, ros2/rosdep.yaml
    "test_commit_message.py",  # tools/commit_message.py
    "test_contributing.py",  # Makefile, git hooks, workflow
    "test_defects.py",  # docs/evidence/defects.md
    "test_judges.py",  # tools/judges
    "test_openigtlink_ng.py",  # tools/judges/openigtlink_ng.py and ng_*.py
    "test_deploy.py",  # deploy/
    "test_docs.py",  # tools/docs.py
    "test_docstrings.py",  # tools/docstrings.py
    "api/test_documents.py",  # docs/how-to/python-*.md
    "test_examples.py",  # examples/
    "test_private_files.py",  # who creates files
    "test_written_files.py",  # every verb's, sessionfile/whole_files.py
    "test_package.py",  # igtl_gateway/__init__.py
    "test_packaging.py",  # pyproject.toml, lab/pyproject.toml
    "test_fixtures.py",  # what the recordings in fixtures/ promise
    "test_fuzz_files.py",  # tools/fuzz_files.py
    "test_fuzz_values.py",  # tools/fuzz_values.py
    "test_truth.py",  # tools/truth
    "test_mutants.py",  # tools/mutants.py
    "test_gateway_fuzz.py",
    "test_ros_package.py",  # ros2/igtl_gateway_ros
    "test_notebooks.py",  # docs/notebooks
    "test_site.py",  # tools/site.py
    "test_tables.py",  # tests/tables.py
    "test_publish.py",  # tools/publish.py
    "test_release.py",  # tools/release.py, hatch_build.py
    "test_terms.py",  # tools/terms.py
    "test_try_release.py",  # tools/try_release.py, docs/start/install.md
    "test_words.py",  # tools/words.py
    "test_workflows.py",  # .github, CITATION.cff
    "record/sessionfile/test_conformance.py",  # MCAP's conformance set through readers and verbs
    "record/sessionfile/test_mcap_fuzz.py",  # tools/mcap_mutations.py
    "wire/test_bodies.py",  # every type of message against one list of checks
    "wire/test_conformance.py",  # every type of message through the command line
    "wire/test_corpus.py",
    "wire/test_fuzz.py",  # tools/fuzz.py
)


def ours(name: str) -> str | None:
    """The name of a module of either distribution, as the tables have it; None for modules of others."""
    package, _, rest = name.partition(".")
    if package == LABORATORY:
        return f"{LAB}.{rest}".removesuffix(".")
    return rest if package == PACKAGE else None


def lies_in(module: str, unit: str) -> bool:
    """Whether ``module`` is ``unit`` or inside it."""
    return unit in {TOP, module} or module.startswith(unit + ".")


def unit_of(module: str) -> str | None:
    """The unit of a module (both relative to the package); None if the table of levels has none."""
    units = [unit for unit in LEVELS if unit != TOP and lies_in(module, unit) and (unit != LAB or module == LAB)]
    if units:
        return max(units, key=len)
    return TOP if module == TOP else None


def imports_of(module: str, is_package: bool, tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and full name of all that is imported; ``from a import b`` gives ``a.b``, be it module or not.

    Calls that import by name give the name, or ``"?"`` where it is not written out.
    """
    for node in ast.walk(tree):
        match node:
            case ast.Import():
                yield from ((node.lineno, alias.name) for alias in node.names)
            case ast.ImportFrom():
                source = node.module or ""
                if node.level:
                    parts = (
                        (f"{LABORATORY}{module.removeprefix(LAB)}" if lies_in(module, LAB) else f"{PACKAGE}.{module}")
                        .rstrip(".")
                        .split(".")
                    )
                    here = parts[: len(parts) - node.level + is_package]
                    source = ".".join([*here, source] if source else here)
                yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)
            case ast.Call(func=ast.Name("import_module" | "__import__") | ast.Attribute(attr="import_module")):
                match node.args:
                    case [ast.Constant(str(name)), *_]:
                        yield node.lineno, name
                    case _:
                        yield node.lineno, "?"


parsed = cache(ast.parse)  # several tests look at each module


@pytest.fixture(scope="module", autouse=True)
def _no_trees_left() -> Iterator[None]:
    """Those of all modules are some hundred megabytes, which Python's collector would look at until the last test."""
    yield
    parsed.cache_clear()


def violations(module: str, source: str, *, is_package: bool = False) -> list[str]:
    """What ``source``, as the module of that name relative to the package, does against the tables."""
    unit = unit_of(module)
    if unit is None:
        return [f"{module}: has no level; add it to LEVELS"]
    tree = parsed(source)
    imports = imports_of(module, is_package, tree)
    if unit in STRANGERS:
        known = [(line, name, other) for line, name in imports if (other := ours(name)) is not None]
        return [f"{module}:{line}: imports {name}" for line, name, other in known if not lies_in(other, unit)]
    found = [(line, fault) for line, name in imports if (fault := _import_fault(module, unit, name))]
    for node in ast.walk(tree):
        match node:
            case ast.Name("print") if not _is_home(module, PRINTERS):
                found.append((node.lineno, "prints; only cli.terminal does"))
            case ast.Attribute(value=ast.Name("sys"), attr="stdout" | "stderr" | "__stdout__" | "__stderr__") if (
                not _is_home(module, STREAM_WRITERS)
            ):
                found.append((node.lineno, f"uses sys.{node.attr}; only cli.terminal does"))
            case ast.Attribute(value=ast.Name(of), attr=attr) if (
                attr in ABSENT.get(of, ())
                and not lies_in(module, LAB)
                and not _is_home(module, ABSENT_HOMES.get(of, ()))
            ):
                found.append((node.lineno, f"uses {of}.{attr}, which Windows does not have"))
            case ast.Attribute(value=ast.Name("traceback"), attr="print_exc" | "print_exception"):
                found.append((node.lineno, "prints; only cli.terminal does"))
            case ast.Attribute(value=ast.Name(of) | ast.Attribute(attr=of), attr=call) if (
                of in {"date", "datetime"} and call in CLOCK_CALLS
            ):
                found.append((node.lineno, f"reads the time by {of}.{call}; only clock does"))
    return [f"{module or PACKAGE}:{line}: {fault}" for line, fault in sorted(found)]


def _import_fault(module: str, unit: str, name: str) -> str | None:
    """Why ``module`` may not import ``name``, or None."""
    if (imported := ours(name)) is not None:
        return _level_fault(unit, imported) or _door_fault(module, imported)
    library = name.partition(".")[0]
    if name == "?":
        return None if module == TOP or _is_home(module, DYNAMIC_IMPORTERS) else "imports a module chosen at run time"
    if library in HOMES:
        if _is_home(module, HOMES[library]):
            return None
        return f"imports {library}, whose home is {' and '.join(HOMES[library]) or 'nowhere'}"
    if library not in sys.stdlib_module_names:
        return f"imports {library}, which has no home"
    if library in IMPURE and LEVELS[unit] <= HIGHEST_PURE_LEVEL and not _is_home(module, BELOW):
        return f"imports {library}, but level {LEVELS[unit]} is pure"
    return None


def _level_fault(unit: str, imported: str) -> str | None:
    """Why ``unit`` may not import that own module, or None."""
    # "from igtl_gateway import __version__" names no module but something in the package's own file.
    other = unit_of(imported) or TOP
    if lies_in(other, LAB) and not lies_in(unit, LAB):
        return f"imports {other}, but the gateway does without its laboratory"
    if other in {unit, TOP} or LEVELS[other] < LEVELS[unit]:
        return None
    siblings = SIBLINGS.get(unit, ())
    if other in ((siblings,) if isinstance(siblings, str) else siblings):
        return None
    # The modules of a folder may use what lies beside them, though not the other way round.
    if LEVELS[other] == LEVELS[unit] and lies_in(unit, other):
        return None
    return f"imports {other} (level {LEVELS[other]}), itself {unit or PACKAGE} (level {LEVELS[unit]})"


def _door_fault(module: str, imported: str) -> str | None:
    """Why a module of an add-on may not import that own module, or None."""
    place, _, rest = module.partition(".")
    if place != "addons" or not rest or lies_in(imported, DOOR) or unit_of(imported) is None:
        return None
    own = rest.partition(".")[0]
    if not lies_in(imported, "addons"):
        return f"imports {imported}, past the door of add-ons: igtl_gateway.{DOOR}"
    other = next(name for name in _and_above(imported) if name in MODULES).removeprefix("addons.")
    known = other.partition(".")[0] == own or other in NEIGHBOURS.get(own, ())
    return None if known else f"imports {other}, which the table of neighbours does not have"


def _and_above(name: str) -> Iterator[str]:
    """A dotted name, and all that it lies in."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def _is_home(module: str, homes: tuple[str, ...]) -> bool:
    return any(lies_in(module, home) for home in homes)


def modules() -> dict[str, Path]:
    """Module name, as the tables have it → file, of both distributions."""
    names = {}
    for package, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            module = ".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])
            names[ours(module) or TOP] = path
    return names


MODULES = modules()


def test_the_package_is_found() -> None:
    assert {TOP, "base.errors", "gateway.log.entry", "wire"} <= MODULES.keys()


def test_modules_keep_to_the_tables() -> None:
    found = [
        fault
        for module, path in MODULES.items()
        for fault in violations(module, path.read_text("utf-8"), is_package=path.name == "__init__.py")
    ]
    assert found == []


def test_modules_say_what_they_are() -> None:
    assert [name for name, path in MODULES.items() if not ast.get_docstring(parsed(path.read_text("utf-8")))] == []


def test_a_clone_alone_has_what_the_tests_need() -> None:
    """No test and no tool looks for data beside the project."""
    beside = re.compile(r"""["'/]shared["'/]""")
    files = [path for folder in ("tests", "tools", "lab") for path in (TESTS.parent / folder).rglob("*.py")]
    assert [str(path) for path in files if beside.search(path.read_text("utf-8"))] == []


#: Function in the walks of ARCHITECTURE.md that is handed over → its name in the caller, and who hands it over.
HANDED = {
    "Hub.igtl": ("_on_frame", "app.bridge", "on_frame=self.hub.igtl"),
    "IgtlReceiver.take": ("stage", "gateway.core", "Kind.IGTL_IN: igtl_receiver.take"),
    "RosReceiver.take": ("stage", "gateway.core", "Kind.ROS_IN: ros_receiver.take"),
    "Bridge._dispatch": ("sink", "app.bridge", "[self._dispatch, *records"),
    "Bridge._record": ("sink", "app.bridge", "records: list[Sink] = [self._record]"),
    "message_callback": ("callback", "edges.ros.edge", "return message_callback(subscription"),
    "RosTraffic._received": ("on_message", "app.ros_traffic", "on_message=self._received"),
}
_STEP = re.compile(r"^( *)(⇢ )?([\w/]+): ([\w.]+)", re.MULTILINE)


def function_of(module: str, name: str) -> ast.FunctionDef:
    """The definition of ``Class.method`` or of a function."""
    body: list[ast.stmt] = parsed(MODULES[module].read_text("utf-8")).body
    for part in name.split("."):
        (found,) = (one for one in body if isinstance(one, ast.ClassDef | ast.FunctionDef) and one.name == part)
        body = found.body
    assert isinstance(found, ast.FunctionDef)
    return found


def mentions(function: ast.FunctionDef, name: str, after: int) -> int | None:
    """The first line from ``after`` on in which a function names another one."""
    lines = [
        node.lineno
        for node in ast.walk(function)
        if (isinstance(node, ast.Attribute) and node.attr == name) or (isinstance(node, ast.Name) and node.id == name)
    ]
    return min((line for line in lines if line >= after), default=None)


def test_the_walks_are_those_of_the_code() -> None:
    """Each line of the two pictures is called by the line that it stands below, no later than its next sibling."""
    pictures = [part for part in (ROOT / "ARCHITECTURE.md").read_text("utf-8").split("```text\n") if _STEP.match(part)]
    assert len(pictures) == 2
    for picture in pictures:
        callers: list[list[Any]] = []  # of each level: the function, and the line that it has come to
        for blanks, handed, place, name in _STEP.findall(picture.partition("```")[0]):
            del callers[len(blanks) // 2 :]
            called = name.rpartition(".")[2]
            if handed:
                called, module, text = HANDED[name]
                assert text in MODULES[module].read_text("utf-8"), name
            if callers:
                caller, line = callers[-1]
                found = mentions(caller, called, line)
                assert found, f"{caller.name} does not call {name} after line {line}"
                callers[-1][1] = found
            function = function_of(place.replace("/", "."), name)
            callers.append([function, function.lineno])
        assert len(callers) > 4


@cache
def imported_modules() -> dict[str, set[str]]:
    """Module → the modules that it imports; a package does not import its own modules."""
    imported = {}
    for module, path in MODULES.items():
        found = set()
        is_package = path.name == "__init__.py"
        for _, name in imports_of(module, is_package, parsed(path.read_text("utf-8"))):
            other = ours(name)
            while other and other not in MODULES:
                other = other.rpartition(".")[0]
            if other and other != module and not (is_package and lies_in(other, module)):
                found.add(other)
        imported[module] = found
    return imported


def test_no_modules_import_each_other_in_a_circle() -> None:
    left = {module: others for module, others in imported_modules().items() if module != TOP}
    while ground := {module for module, others in left.items() if not others & left.keys()}:
        left = {module: others for module, others in left.items() if module not in ground}
    assert left == {}, "these are in a circle, or above one"


def test_a_level_is_one_above_what_its_folder_imports() -> None:
    """So the levels are those of any program that counts imports."""
    imported: dict[str, set[str]] = {}
    for module, others in imported_modules().items():
        if module != TOP and not lies_in(module, LAB):
            folders = imported.setdefault(module.partition(".")[0], set())
            folders |= {other.partition(".")[0] for other in others}

    def level(folder: str) -> int:
        return 1 + max((level(other) for other in imported[folder] if other != folder), default=0)

    assert {folder: level(folder) for folder in imported} == {folder: LEVELS[folder] for folder in imported}


def test_addons_use_the_neighbours_that_the_table_names() -> None:
    used: dict[str, set[str]] = {}
    for module, others in imported_modules().items():
        if lies_in(module, "addons") and module.count(".") > 1:
            own = module.split(".")[1]
            found = {other for other in others if lies_in(other, "addons") and not lies_in(other, f"addons.{own}")}
            used.setdefault(own, set()).update(other.removeprefix("addons.") for other in found)
    assert {own: tuple(sorted(found)) for own, found in used.items() if found} == NEIGHBOURS


#: The groups of the door that load their names at first use, and the door itself.
LAZY = [DOOR, *(f"{DOOR}.{group}" for group in addon.GROUPS)]


def test_the_groups_of_the_door_are_its_modules() -> None:
    own = {name for name in MODULES if lies_in(name, DOOR)}
    assert own == {*LAZY, *(f"{DOOR}.{name}" for name in ("igtl", "ros", "loading"))}


@pytest.mark.parametrize("group", LAZY)
def test_a_group_of_the_door_has_what_it_names(group: str) -> None:
    """A type checker sees the imports, a program the table: both have the same names, each from one group."""
    module = import_module(f"{PACKAGE}.{group}")
    seen = {
        alias.asname: (node.module.removeprefix(f"{PACKAGE}."), alias.name)
        for node in ast.walk(parsed(MODULES[group].read_text("utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and not lies_in(node.module, f"{PACKAGE}.{DOOR}")
        for alias in node.names
        if alias.asname
    }
    assert home_of(module.HOMES) == seen
    assert [name for name in seen if not hasattr(module, name)] == []
    assert seen.keys() <= set(dir(module))


def test_who_comes_through_the_door_finds_the_names() -> None:
    names = {f"{PACKAGE}.{group}": import_module(f"{PACKAGE}.{group}") for group in LAZY}
    missing = [
        f"{path}:{node.lineno}: {node.module}.{alias.name}"
        for folder in ("igtl_gateway", "lab", "tests", "tools", "examples")
        for path in (ROOT / folder).rglob("*.py")
        if f"from {PACKAGE}.{DOOR}" in (text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module in names
        for alias in node.names
        if alias.name not in {*home_of(names[node.module].HOMES), *addon.GROUPS, "igtl", "ros"}
    ]
    assert missing == []


def test_a_name_of_the_door_is_in_one_group() -> None:
    names = [name for group in LAZY for name in home_of(import_module(f"{PACKAGE}.{group}").HOMES)]
    assert len(names) == len(set(names)) and not set(names) & set(addon.GROUPS)


def test_a_name_that_the_door_does_not_have_is_an_error_of_attributes() -> None:
    with pytest.raises(AttributeError, match=r"'igtl_gateway\.addon\.reading' has no attribute 'SessionWriter'"):
        import_module(f"{PACKAGE}.{DOOR}.reading").SessionWriter  # noqa: B018


def mirrored(test: Path) -> bool:
    """Whether the test file, relative to the folder of tests, lies where its module lies in the package."""
    if any(test.is_relative_to(exception) for exception in UNMIRRORED):
        return True
    module = ".".join([*test.parent.parts, test.stem.removeprefix("test_")])
    return module in MODULES and module != TOP


def test_tests_mirror_the_package() -> None:
    tests = [path.relative_to(TESTS) for path in TESTS.rglob("test_*.py")]
    assert [str(test) for test in tests if not mirrored(test)] == []


@table(
    ("module", "source"),
    [
        ("base.stamp", "import math, struct"),
        ("base.clock", "import time"),
        ("gateway.log.entry", "from igtl_gateway.base.buffers import Buffer"),
        ("wire.message", "import numpy as np\nimport fastcrc\nfrom igtl_gateway.wire.body import Body"),
        ("wire.message", "from .body import Body\nfrom ..base.errors import WireError"),
        ("convert.table", "from igtl_gateway.gateway.log.entry import Entry\nfrom igtl_gateway import wire"),
        ("config.configuration", "from igtl_gateway.convert.units import Lengths"),
        ("gateway", "from igtl_gateway import __version__, convert"),
        ("edges.tcp.loop", "import selectors, socket, threading"),
        ("edges.tcp.sender", "import select\nfrom igtl_gateway.edges.tcp.loop import Loop"),
        ("edges.ros.middleware", "import rclpy.node\nfrom igtl_gateway.edges.ros import env"),
        ("edges.ros.middleware", "import importlib\nimportlib.import_module(name)"),
        ("record.sessionfile.writer", "from mcap.writer import Writer"),
        ("replay.verify", "from igtl_gateway.gateway import Gateway\nfrom rosbags.typesys import Stores"),
        ("lab.simulate.star", "import random"),
        (
            "lab.stage.live",
            "from igtl_gateway.config.configuration import Config\nfrom igtl_gateway_lab.simulate import scenario",
        ),
        ("app", "from igtl_gateway.record.recorder import Recorder\nfrom igtl_gateway.edges import ros, tcp"),
        ("cli.bridge", "def run():\n    from igtl_gateway.app import App\n    return App()"),
        ("__main__", "from igtl_gateway.cli import main"),
        ("lab.demo.ros_node", "import rclpy, time\nfrom igtl_gateway_lab.demo import pattern\nprint(time.time())"),
        ("base.stamp", "from datetime import datetime, timezone\ndatetime.fromtimestamp(0, timezone.utc)"),
        (
            "addons.page.live",
            "from igtl_gateway import __version__, open\nfrom igtl_gateway.addon import NS_PER_S, ros",
        ),
        ("addons.page.live", "from igtl_gateway.addon.live import Bridge\nfrom igtl_gateway.addons.page import now"),
        ("addons.view.verb", "from igtl_gateway.addons.sync.lag import Lag\nfrom .pen import Pen"),
    ],
)
def test_what_is_allowed(module: str, source: str) -> None:
    assert violations(module, source) == []


@table(
    ("module", "source", "fault"),
    [
        # What Windows does not have
        ("record.retention.stored", "import fcntl", "imports fcntl, whose home is base.systems.files"),
        (
            "record.host",
            "import signal\nsignal.SIGHUP",
            "record.host:2: uses signal.SIGHUP, which Windows does not have",
        ),
        # Upwards
        ("base.stamp", "import igtl_gateway.wire.message", "imports wire (level 2)"),
        ("wire.message", "from igtl_gateway.convert import table", "imports convert (level 3)"),
        ("wire.message", "from igtl_gateway import gateway", "imports gateway (level 5)"),
        ("gateway", "from igtl_gateway.edges import tcp", "imports edges.tcp (level 6)"),
        ("record.recorder", "from igtl_gateway.app import App", "imports app (level 8)"),
        ("app", "from igtl_gateway.cli import main", "imports cli (level 9)"),
        ("cli.info", "from igtl_gateway_lab.simulate import star", "does without its laboratory"),
        ("lab.simulate.star", "from igtl_gateway_lab.stage import live", "imports lab.stage (level 9)"),
        # Programs that play foreign software
        (
            "lab.demo.igtl_client",
            "from igtl_gateway.wire import encode",
            "demo.igtl_client:1: imports igtl_gateway.wire",
        ),
        ("lab.demo.igtl_client", "from igtl_gateway.base import errors", "imports igtl_gateway.base.errors"),
        # Sideways
        ("wire.message", "from igtl_gateway.gateway.log.entry import Entry", "imports gateway.log (level 2)"),
        ("gateway.log.entry", "from igtl_gateway.wire import Message", "imports wire (level 2)"),
        ("convert.table", "from igtl_gateway.config.configuration import Config", "imports config (level 4)"),
        ("edges.tcp", "from igtl_gateway.edges.ros.edge import Node", "imports edges.ros (level 6)"),
        ("edges.ros", "from . import tcp", "imports edges.tcp (level 6)"),
        ("edges.ros", "from igtl_gateway.edges.tcp.loop import Loop", "imports edges.tcp (level 6)"),
        ("edges.video.worker", "from igtl_gateway.edges import ros", "imports edges.ros (level 6)"),
        ("record.recorder", "from igtl_gateway.replay import verify", "imports replay (level 7)"),
        ("edges.ros", "from igtl_gateway.record import recorder", "imports record (level 6)"),
        # The core does without its add-ons
        ("app.hub", "from igtl_gateway.addons.view import live", "imports addons (level 11)"),
        ("cli.info", "from igtl_gateway.addons import merge", "imports addons (level 11)"),
        # Add-ons have one door
        ("addons.page.live", "from igtl_gateway.app.bridge import Bridge", "past the door of add-ons"),
        ("addons.page.live", "from igtl_gateway import api", "imports api, past the door of add-ons"),
        ("addons.page.live", "import igtl_gateway.base.qos", "imports base.qos, past the door of add-ons"),
        ("addons.page.live", "from ...base import qos", "imports base.qos, past the door of add-ons"),
        ("addons.page.live", "def f():\n    from igtl_gateway.wire import decode", "past the door of add-ons"),
        ("addons.sync.lag", "from igtl_gateway.addons.view import pen", "imports view.pen, which"),
        ("addons.view.verb", "from igtl_gateway.addons.sync.search import found", "imports sync.search, which"),
        # Wherever it is written
        ("wire.message", "def f():\n    import igtl_gateway.gateway", "wire.message:2: imports gateway"),
        ("wire.message", "if TYPE_CHECKING:\n    from igtl_gateway.app import App", "wire.message:2: imports app"),
        ("addons.view.log", "__import__('rclpy')", "imports rclpy"),
        ("addons.view.log", "from importlib import import_module\nimport_module('mcap.reader')", "imports mcap"),
        ("addons.view.log", "import importlib\nimportlib.import_module(name)", "chosen at run time"),
        # Homes
        ("app", "import rclpy", "imports rclpy, whose home is edges.ros.middleware"),
        ("edges.video", "from rclpy.node import Node", "imports rclpy"),
        ("app", "import rerun as rr", "imports rerun"),
        ("record.recorder", "from mcap.writer import Writer", "imports mcap"),
        ("convert.cdr", "from rosbags.typesys import Stores", "imports rosbags"),
        ("base.values", "import numpy", "imports numpy"),
        ("wire.framer", "import socket", "imports socket"),
        ("edges.ros", "import socket", "imports socket, whose home is edges.tcp"),
        ("edges.tcp.edge", "import selectors", "imports selectors, whose home is edges.tcp.loop"),
        ("app", "import asyncio", "imports asyncio"),
        ("convert.names", "import crcmod", "imports crcmod, which has no home"),
        # Time, chance and the environment
        ("app", "import time", "imports time"),
        ("app", "from time import sleep", "imports time"),
        ("gateway", "import random", "imports random"),
        ("convert.names", "import os", "level 3 is pure"),
        ("app", "from datetime import datetime\ndatetime.now()", "app:2: reads the time by datetime.now"),
        ("app", "import datetime\ndatetime.datetime.utcnow()", "reads the time by datetime.utcnow"),
        # Words
        ("app", "print('hello')", "prints"),
        ("cli.info", "print('hello')", "cli.info:1: prints; only cli.terminal does"),
        ("cli.info", "show = print", "prints"),
        ("cli.info", "import sys\nsys.stdout.write('hello')", "uses sys.stdout; only cli.terminal does"),
        ("app.hub", "import sys\nfile = sys.stderr", "uses sys.stderr"),
        ("replay.verify", "import traceback\ntraceback.print_exc()", "prints"),
        # A module that the table does not know
        ("utils", "", "has no level"),
    ],
)
def test_what_is_refused(module: str, source: str, fault: str) -> None:
    found = violations(module, source)
    assert len(found) == 1
    assert fault in found[0]


def test_relative_imports_of_a_package_start_at_itself() -> None:
    assert violations("wire", "from .message import Message", is_package=True) == []
    assert violations("wire", "from ..convert import table", is_package=True) != []
    assert violations("", "from .cli import main", is_package=True) != []


def test_a_test_without_its_module_is_seen() -> None:
    assert mirrored(Path("gateway/log/test_entry.py"))
    assert mirrored(Path("peers/test_reference.py"))
    assert not mirrored(Path("gateway/log/test_wire.py"))
    assert not mirrored(Path("test_entry.py"))


def test_the_longest_files_of_tests_are_there() -> None:
    assert [name for name in LONGEST if not (TESTS / name).is_file()] == []
