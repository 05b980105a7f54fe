"""3D Slicer's storage nodes on files: what ``export`` writes, and what ``import`` reads of theirs.

    python -m tools.judges.slicer_files

Strategy: the checks are those of the tests (tests/integration/slicer), which compare files with the recorded values;
here each is a row with the number of files that were compared.  A line in Slicer's log fails, too.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from igtl_gateway.addons.exchange.surface_out import export_ply, export_vtk
from tests import slicer
from tests.integration.slicer import test_exports as exports
from tests.integration.slicer import test_imports as imports
from tools.judges import results
from tools.judges.results import BOTH, EXACT, FAILS, Row


def checks() -> Iterator[tuple[str, Callable[[Any, Path], object]]]:
    """Yield what is compared, and its check on a scene and a folder."""
    for fixture in exports.FIXTURES:
        yield "export: pictures (.nrrd)", _with(exports.test_slicer_reads_each_exported_image_of_a_fixture, fixture)
        for export, suffix in ((export_vtk, "vtk"), (export_ply, "ply")):
            check = exports.test_slicer_reads_each_exported_surface_of_a_fixture
            yield f"export: surfaces and clouds (.{suffix})", _with(check, fixture, export, suffix)
        yield "export: tables (.csv)", _with(exports.test_slicer_reads_each_exported_table_of_a_fixture, fixture)
    for name in ("ultrasound", "star", "lego"):
        check = exports.test_slicer_reads_each_transform_of_an_exported_sequence
        yield "export: transforms of a sequence (.igs.mha)", _with(check, name)
    yield "export: pictures of all types, orders and orientations", exports.test_slicer_reads_pictures_of_every_kind
    for suffix in imports.TRANSFORMS:
        yield f"import: a linear transform ({suffix})", _with(imports.test_a_transform_that_slicer_wrote, suffix)
        if suffix != ".mat":
            yield f"import: a composite ({suffix})", _with(imports.test_a_composite_that_slicer_wrote, suffix)
    for kind in ("Fiducial", "Angle", "Curve", "ClosedCurve"):
        yield "import: points (.mrk.json)", _with(imports.test_points_that_slicer_wrote, kind, ".mrk.json")
    yield "import: points (.fcsv)", _with(imports.test_points_that_slicer_wrote, "Fiducial", ".fcsv")
    for older in imports.OLDER:
        yield (
            "import: points of versions 4.0 to 5.0 (.fcsv)",
            _with(imports.test_points_of_other_versions_are_where_slicer_reads_them, older),
        )
    yield "import: lines, planes and boxes (.mrk.json)", imports.test_a_line_that_slicer_wrote_is_a_path
    yield (
        "import: lines, planes and boxes (.mrk.json)",
        imports.test_a_plane_and_a_box_that_slicer_wrote_are_surfaces_too,
    )


def _with(check: Callable[..., object], *values: object) -> Callable[[Any, Path], object]:
    return lambda scene, folder: check(scene, folder, *values)


class _Counted:
    """A function with the number of its calls: the files that Slicer read."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.count = 0

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        self.count += 1
        return self._function(*arguments, **named)


def main() -> int:
    """Run all checks and write the file."""
    rows: list[Row] = []
    slicer.read = read = _Counted(slicer.read)
    for what, check in checks():
        read.count = 0
        with tempfile.TemporaryDirectory() as name:
            try:
                check(slicer.new_scene(Path(name) / "cache"), Path(name))
            except Exception as error:  # a judge reports whatever fails
                rows.append(Row(what, BOTH, FAILS, 1, str(error).splitlines()[0][:200] if str(error) else repr(error)))
            else:
                rows.append(Row(what, BOTH, EXACT, max(1, read.count) if what.startswith("export") else 1))
    text = f"slicer-core {version('slicer-core')}"
    return results.write(
        "slicer-files", "3D Slicer's storage nodes", text, "reader and writer of files", results.summed(rows)
    )


if __name__ == "__main__":
    sys.exit(main())
