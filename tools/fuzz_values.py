"""Files with one wrong value, by a grammar of each format: ``python -m tools.fuzz_values --seconds 600 --seed 1``.

A case has the name ``FORMAT/FIELD=CHOICE/SEED`` and is made again from it: ``--case NAME`` reads one case by all its
readers, and ``--case NAME --write FOLDER`` writes its files.  Each case is read in this process, and every n-th instead
by a verb of the command line (``--verbs``).  The checks are those of ``tools.fuzz_files``: only errors of the package,
5 s of the processor, 200 MB more than before, no control characters; the process has 4 GB of address space.

Kinds are struck in an order that depends on the seed, each once before one is struck again.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from igtl_gateway.addons.deidentify.profile import read_profile
from igtl_gateway.addons.lerobot.recipe_file import read_recipe
from igtl_gateway.addons.view.urdf import parse_urdf
from igtl_gateway.base.untrusted.files import read_bytes
from igtl_gateway.base.untrusted.text import printable
from igtl_gateway.record.seal.keys import load_trusted
from tools import fuzz_files
from tools.fuzz_files import Reader, Report, read_configuration, read_import, run, verb
from tools.import_mutations import Case
from tools.kinds import documents, others, recordings, sealed, tables
from tools.kinds.values import CHOICES, Maker

_MEMORY_BYTES = 4 << 30
#: Seeds that are tried to find all fields of a format, whose variants follow from the seed.
_TRIED = 120
#: One of this number of cases is read by a verb.
VERBS_EVERY = 20


@dataclass(frozen=True, slots=True)
class Format:
    """A format: how a file of it is made, how it is read in this process, and by verbs (``F`` is the file)."""

    make: Callable[[Maker], Mapping[str, bytes]]
    read: Callable[[Path, Random], str]
    verbs: tuple[str, ...] = ("import F --out O.mcap", "info F")


def _reads(read: Callable[[Path], object]) -> Callable[[Path, Random], str]:
    def one(path: Path, _rng: Random) -> str:
        read(path)
        return "read"

    return one


def _verb_only(words: str) -> Callable[[Path, Random], str]:
    return lambda path, _rng: verb(path, words)


_GOOD = str(Path(__file__).resolve().parents[1] / "fixtures" / "acquisition.mcap")
FORMATS = {
    "session": Format(recordings.session, _reads(fuzz_files.read_session), fuzz_files.MCAP_VERBS),
    "rosbag1": Format(others.rosbag1, read_import),
    "rosbag2": Format(others.rosbag2, read_import),
    "pcap": Format(others.pcap, read_import),
    "pcapng": Format(others.pcapng, read_import),
    "igtl": Format(others.stream, read_import, ("import F --out O.mcap", "decode F")),
    "metaimage": Format(others.metaimage, read_import),
    "nrrd": Format(others.nrrd, read_import),
    "nifti": Format(others.nifti, read_import),
    "configuration": Format(documents.configuration, read_configuration, (f"lint {_GOOD} --config F",)),
    "profile": Format(documents.profile, _reads(read_profile), (f"deidentify {_GOOD} -o O.mcap --profile F",)),
    "recipe": Format(documents.recipe, _reads(read_recipe), (f"export {_GOOD} --to lerobot --recipe F --out O",)),
    "robot": Format(documents.robot, _reads(lambda path: parse_urdf(read_bytes(path), str(path))), ()),
    "rosbag2mcap": Format(others.rosbag2_mcap, read_import),
    "seal": Format(sealed.seal, sealed.read_seal, ("verify F --seal", "info F", "recover F -o O.mcap")),
    "time stamp": Format(sealed.time_stamp, sealed.read_time_stamp, ()),
    "parquet": Format(tables.table, tables.read_table, ()),
    "lerobot": Format(tables.data_set, tables.read_data_set, (f"export {_GOOD} --to lerobot --check F",)),
    "key": Format(documents.key, _reads(lambda path: load_trusted([path])), ("keys show F",)),
}


@cache
def kinds(name: str) -> tuple[str, ...]:
    """Return all kinds of a format: its fields, found by making files without a wrong value, with all choices."""
    fields: dict[str, str] = {}
    for seed in range(_TRIED):
        maker = Maker(seed)
        FORMATS[name].make(maker)
        fields |= maker.fields
    return tuple(f"{field}={choice}" for field, code in sorted(fields.items()) for choice in CHOICES[code])


def case_of(name: str) -> Case:
    """Return the case of a name ``FORMAT/FIELD=CHOICE/SEED``."""
    form, _, rest = name.partition("/")
    kind, _, seed = rest.rpartition("/")
    return Case(name, FORMATS[form].make(Maker(int(seed), kind)))


def cases(form: str, seed: int, fields: str = "") -> Iterator[Case]:
    """Yield cases of a format without end: each kind once, in an order of the seed, and again with other contents.

    Only fields whose names begin with ``fields`` are struck.
    """
    found = [kind for kind in kinds(form) if kind.startswith(fields)]
    for turn in itertools.count():
        Random(f"{seed}-{turn}").shuffle(found)
        for number, kind in enumerate(found):
            yield case_of(f"{form}/{kind}/{(seed * 1_000_003 + turn * len(found) + number) % (1 << 31)}")


def _reader(form: str, verbs_every: int, fields: str) -> Reader:
    one = FORMATS[form]

    def read(path: Path, rng: Random) -> str:
        if one.verbs and verbs_every and rng.randrange(verbs_every) == 0:
            return verb(path, rng.choice(one.verbs))
        return one.read(path, rng)

    return Reader(lambda seed: cases(form, seed, fields), read)


def readers(verbs_every: int = VERBS_EVERY, fields: str = "") -> dict[str, Reader]:
    """Return a reader for each format that has such fields, for ``fuzz_files.run``."""
    return {
        form: _reader(form, verbs_every, fields)
        for form in FORMATS
        if not fields or any(kind.startswith(fields) for kind in kinds(form))
    }


def one(name: str, out: Path | None) -> dict[str, Report]:
    """Read one case by the reader of its format and by each of its verbs."""
    form = FORMATS[name.partition("/")[0]]
    found = {"read": form.read, **{words: _verb_only(words) for words in form.verbs}}
    made = {key: Reader(lambda _seed: itertools.repeat(case_of(name)), read) for key, read in found.items()}
    return run(0, lambda done: not done, tuple(made), out, known=made, size=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="another seed, another order and contents (%(default)s)")
    parser.add_argument("--format", action="append", choices=FORMATS, help="only this one; may be repeated")
    parser.add_argument("--verbs", type=int, default=VERBS_EVERY, metavar="N",
                        help="read each Nth case by a verb; 0: none (%(default)s)")  # fmt: skip
    parser.add_argument(
        "--fields", default="", metavar="PREFIX", help="only fields whose names begin so, such as config"
    )
    parser.add_argument("--case", metavar="NAME", help="read this case only, by its reader and all its verbs")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="with --case: only write its files")
    parser.add_argument("--kinds", action="store_true", help="print the number of kinds of each format")
    parser.add_argument("--out", type=Path, default=Path("fuzz-broken"), help="where culprits go (%(default)s)")
    options = parser.parse_args()
    if options.kinds:
        for form in FORMATS:
            print(f"{form}: {len(kinds(form)):,}")
        return 0
    if options.case and options.write:
        options.write.mkdir(parents=True, exist_ok=True)
        print(case_of(options.case).write(options.write))
        return 0
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    if options.case:
        reports = one(options.case, options.out)
    else:
        signal.signal(signal.SIGTERM, lambda _number, _frame: signal.raise_signal(signal.SIGINT))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        end = time.monotonic() + options.seconds
        known = readers(options.verbs, options.fields)
        reports = run(
            options.seed, lambda _: time.monotonic() < end, tuple(options.format or known), options.out, known=known
        )
    for name, report in reports.items():
        print(f"seed {options.seed}, {name}: {report.text()}")
        for key, why in report.broken.items():
            print(f"  BROKEN {printable(key)}: {printable(why.strip().rpartition(chr(10))[2][:300])}")
    return int(any(report.broken for report in reports.values()))


if __name__ == "__main__":
    sys.exit(main())
