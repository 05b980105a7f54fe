"""The verbs of the command line: those of this package, and those that other distributions add by entry points.

A distribution adds a verb by an entry point of the group ``igtl_gateway.verbs``: its name is the verb, its value names
a ``Verb``.  The laboratory (``igtl-gateway-lab``) adds ``simulate``, ``bench`` and ``demo`` that way.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata

GROUP = "igtl_gateway.verbs"


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb of the command line.

    Attributes:
        help: one line of help.
        module: full name of the module that has ``EXAMPLES``, ``add_arguments(parser)`` and ``run(options) -> int``;
            it is imported only when the verb is asked for.
        reads_files: whether it reads files that somebody else may have written; such a verb has ``--limit``.
    """

    help: str
    module: str
    reads_files: bool = True


def _own(name: str, text: str, *, reads_files: bool = True) -> Verb:
    return Verb(text, f"igtl_gateway.cli.{name}", reads_files)


VERBS = {
    "bridge": _own("bridge", "run the gateway between OpenIGTLink and ROS 2, and record it", reads_files=False),
    "replay": _own("replay", "drive OpenIGTLink or ROS 2 from a recording"),
    "verify": _own("verify", "prove that a recording's outputs follow from its inputs, byte for byte"),
    "diff": _own("diff", "compare two recordings, stream by stream, in millimetres and degrees"),
    "slice": _own("slice", "cut a part out of a recording, by time and stream, that still verifies"),
    "import": _own("import_", "make a session of another program's recording"),
    "export": _own("export", "write a session in the formats of other programs"),
    "recover": _own("recover", "make a whole file of a damaged one, and tell what is lost"),
    "info": _own("info", "what is in a recording"),
    "doctor": _own("doctor", "connect to a peer, or wait for one, and say what is wrong", reads_files=False),
    "lint": _own("lint", "the rules of doctor on a recording"),
    "view": _own("view", "a session in rerun: its window, a file, a page, a picture"),
    "review": _own("review", "is every stitch of a suture plan on the tissue, and how sure is the camera"),
    "decode": _own("decode", "print the messages of a raw OpenIGTLink byte stream as JSON lines"),
}

#: Verbs of the laboratory, to say where they are when it is not installed.
LABORATORY = ("simulate", "bench", "demo")
WITHOUT_LABORATORY = "this verb is part of the laboratory, which is not installed: pip install igtl-gateway-lab"


def available() -> dict[str, Verb]:
    """Name → verb: our own, which nothing replaces, then those of other distributions by name.

    One that cannot be loaded has no module and says why in its help: the other verbs work on.
    """
    verbs = dict(VERBS)
    for entry in sorted(metadata.entry_points(group=GROUP), key=lambda each: each.name):
        if entry.name not in verbs:
            verbs[entry.name] = _loaded(entry)
    return verbs


def _loaded(entry: metadata.EntryPoint) -> Verb:
    try:
        verb = entry.load()
    except Exception as error:  # whatever the code of another distribution raises
        return Verb(f"found a verb that cannot be loaded from {entry.value}: {error}", "")
    return verb if isinstance(verb, Verb) else Verb(f"found no Verb at {entry.value}", "")
