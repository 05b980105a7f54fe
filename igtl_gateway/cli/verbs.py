"""The verbs of the command line: those of the core, of its add-ons, and of other distributions.

An add-on (`igtl_gateway.base.addons`) has its verbs in its folder: ``VERBS`` of its ``addon.py``.

A distribution adds a verb by an entry point of the group ``igtl_gateway.verbs``: its name is the verb, its value names
a ``Verb``.  The laboratory (``igtl-gateway-lab``) adds ``simulate``, ``bench`` and ``demo`` that way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from igtl_gateway.base.addons import ADDONS, FOLDER, is_present, part_of

if TYPE_CHECKING:
    from importlib import metadata

GROUP = "igtl_gateway.verbs"

#: Groups of verbs in the help, in its order.
START, RUN, INSPECT, CONVERT, KEEP = "Start", "Run", "Inspect", "Convert", "Keep"
MANY, MEASURE, OTHER = "Many", "Measure", "Other"
#: Verbs that only ``--help-all`` lists.
RARE = "Rarely needed"
GROUPS = (START, RUN, INSPECT, CONVERT, KEEP, MANY, MEASURE, OTHER, RARE)


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of the command line.

    Attributes:
        help: one line of help.
        module: full name of the module that has ``EXAMPLES``, ``add_arguments(parser)`` and ``run(options) -> int``, or
            ``runner()`` that imports and returns ``run``; it is imported only when the verb is requested.
        reads_files: whether it reads untrusted files; such a verb has ``--limit``.
        writes_files: whether it writes files and has no setting for their mode; such a verb has ``--file-mode``.
        group: where the help lists it, of ``GROUPS``.
        place: in its group, the smallest first.
        now: the new spelling of a verb that is kept for one release; it prints this.
        failure: exit code of an error; 2 for a verb whose 1 is a verdict.
        lasts: it runs as long as a session, a service or other programs: its CPU time has no bound.
    """

    help: str
    module: str
    reads_files: bool = True
    writes_files: bool = False
    group: str = OTHER
    place: int = 99
    now: str = ""
    failure: int = 1
    lasts: bool = False

    @property
    def is_bounded(self) -> bool:
        """Whether ``--limit seconds`` bounds its CPU time."""
        return self.reads_files and not self.lasts


def _own(
    name: str,
    text: str,
    group: str,
    place: int,
    *,
    reads_files: bool = True,
    writes_files: bool = False,
    lasts: bool = False,
) -> Verb:
    return Verb(text, f"igtl_gateway.cli.{name}", reads_files, writes_files, group, place, lasts=lasts)


VERBS = {
    "bridge": _own("bridge", "run the gateway between OpenIGTLink and ROS 2", RUN, 1, reads_files=False),
    "replay": _own("replay", "send a recording to OpenIGTLink peers, to ROS 2 or to both", RUN, 2, lasts=True),
    "verify": _own("verify", "check that the outputs follow from the inputs, byte for byte", INSPECT, 3),
    "diff": _own("diff", "compare two recordings by stream, in millimetres and degrees", INSPECT, 4),
    "slice": _own(
        "slice", "cut a part out of a recording, by time and stream; it verifies", CONVERT, 3, writes_files=True
    ),
    "recover": _own("recover", "repair a damaged recording and report what is lost", CONVERT, 5, writes_files=True),
    "seal": _own("seal", "sign a recording: verify --seal finds every change; seal keys", KEEP, 1, writes_files=True),
    "keys": Verb(
        "make, rotate and show the keys of seals",
        "igtl_gateway.cli.seal_keys",
        False,
        group=RARE,
        place=3,
        now="seal keys",
    ),
    "mark": _own("mark", "add a mark to a closed recording, in a file beside it", KEEP, 4, writes_files=True),
    "keep": _own("keep", "copy the recordings of a directory to a store, delete old ones", KEEP, 2, lasts=True),
    "retain": Verb(
        "delete recordings of a directory by age and by size",
        "igtl_gateway.cli.keep",
        group=RARE,
        place=5,
        now="keep",
        lasts=True,
    ),
    "info": _own("info", "show the contents of a recording", INSPECT, 1),
    "doctor": _own("doctor", "diagnose a connection, a recording or this machine", START, 3),
    "lint": Verb(
        "check a recording with the rules of doctor", "igtl_gateway.cli.lint", group=RARE, place=4, now="doctor"
    ),
    "decode": _own("decode", "print the messages of an OpenIGTLink byte stream as JSON lines", INSPECT, 7),
    "completion": _own(
        "completion", "print a script that completes words in bash, zsh or fish", RARE, 1, reads_files=False
    ),
}

#: Verbs of the laboratory, for the error message if it is not installed.
LABORATORY = ("simulate", "bench", "demo")
WITHOUT_LABORATORY = (
    "found no laboratory, which has this verb; install it: pip install --find-links FOLDER igtl-gateway-lab, where "
    "FOLDER has the files of the release, or pip install ./lab in the sources"
)

#: Two words → the verb of this name, with one of these words behind them: otherwise the second is a file.
JOINED: dict[tuple[str, ...], tuple[str, tuple[str, ...]]] = {
    ("seal", "keys"): ("keys", ("new", "rotate", "show", "-h", "--help"))
}

#: Verbs of other programs → how it is done here.
OTHER_WORDS = {
    "record": "bridge --record FILE",
    "play": "replay FILE",
    "convert": "import FILE, from files of other programs, or export FILE, to them",
}

#: Verb of an add-on → the add-on.
_ADDON_OF = {verb: addon for addon, verbs in ADDONS.items() for verb in verbs}


def own_verb(name: str) -> Verb | None:
    """Return a verb of this distribution; one of an absent add-on has no module, and its help has the reason."""
    if name in VERBS:
        return VERBS[name]
    addon = _ADDON_OF.get(name)
    if addon is None:
        return None
    if not is_present(addon):
        return Verb(f"found no add-on {addon!r}, which has this verb: {FOLDER}.{addon} is not installed", "")
    verbs: Mapping[str, Verb] = part_of(addon, "addon:VERBS")
    return verbs[name]


def available() -> dict[str, Verb]:
    """Return name → verb: first the own verbs, which nothing replaces, then those of other distributions by name.

    A verb that cannot be loaded has no module, and its help has the reason; the other verbs keep working.
    """
    from importlib import metadata  # here: our own verbs do not wait for it

    verbs = dict(VERBS)
    for name, addon in _ADDON_OF.items():
        if is_present(addon) and (verb := own_verb(name)):
            verbs[name] = verb
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda each: each.name):
        if entry.name not in verbs:
            verbs[entry.name] = _loaded(entry)
    return verbs


def groups(verbs: Mapping[str, Verb]) -> dict[str, dict[str, Verb]]:
    """Return verbs by group, in the order of the help; a group that is unknown becomes that of others."""
    found: dict[str, dict[str, Verb]] = {group: {} for group in GROUPS}
    for name, verb in sorted(verbs.items(), key=lambda row: row[1].place):
        found[verb.group if verb.group in found else OTHER][name] = verb
    return {group: rows for group, rows in found.items() if rows}


def _loaded(entry: metadata.EntryPoint) -> Verb:
    try:
        verb = entry.load()
    except Exception as error:  # whatever the code of another distribution raises
        return Verb(f"cannot load this verb from {entry.value}: {error}", "")
    if isinstance(verb, Verb):
        return verb
    return Verb(f"cannot load this verb: found {verb!r} at {entry.value}, expected a Verb", "")
