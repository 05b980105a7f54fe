"""Run the notebooks in docs/notebooks and store their outputs.

    .venv/bin/python tools/notebooks.py            run them and write the outputs
    .venv/bin/python tools/notebooks.py --check    run them; do they print what is stored?

Strategy: the stored outputs are what the site shows, so a reader sees results without running anything.  Printed text
must be equal in every run.  Pictures depend on the version of Matplotlib: a run must have one where one is stored.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "notebooks"
TIMEOUT_S = 120


def run(path: Path) -> dict[str, Any]:
    """Return the notebook with the outputs of a new run, without counters, times and the names of this machine.

    Raises ``nbclient.exceptions.CellExecutionError`` if a cell fails.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(path.parent)}})
    client.execute()
    document: dict[str, Any] = json.loads(nbformat.writes(notebook))
    document["metadata"] = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for cell in document["cells"]:
        cell["metadata"] = {}
        if cell["cell_type"] == "code":
            cell["execution_count"] = None
            for output in cell["outputs"]:
                if "image/png" in output.get("data", {}):
                    output["data"].pop("text/plain", None)  # "<Figure size …>"
                if "execution_count" in output:
                    output["execution_count"] = None
    return document


def shown(document: dict[str, Any]) -> list[list[str]]:
    """For each cell the outputs that a reader sees: text, or ``picture``."""
    return [[_text(output) for output in cell.get("outputs", ())] for cell in document["cells"]]


def _text(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    return "picture" if "image/png" in data else "".join(output.get("text", data.get("text/plain", "")))


def main(arguments: Sequence[str]) -> int:
    """Write the outputs, or with ``--check`` compare them; 1 where they differ."""
    different = False
    for path in sorted(FOLDER.glob("*.ipynb")):
        document = run(path)
        if list(arguments) != ["--check"]:
            path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", "utf-8")
        elif shown(document) != shown(json.loads(path.read_text("utf-8"))):
            print(f"docs/notebooks/{path.name} prints other outputs than stored: python tools/notebooks.py")
            print(shown(document))
            different = True
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
