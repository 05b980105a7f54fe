#!/bin/sh
# VTK (and 3D Slicer, which reads its tables with it): a quote in a quoted cell, written twice as in RFC 4180, ends the cell.
#
# Expected: the cell "say ""hi"" now" is: say "hi" now; a line break in a quoted cell stays in the cell.
# Found: the cell is: ' now' (what stands before the last pair of quotes is lost), and the line break begins a new row.  No error.
# Versions: vtk 9.6.2, slicer-core 5.13.31053.0.
# Concerns: tables with text, such as commands in XML or robot descriptions, that are opened in 3D Slicer or ParaView.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check slicer-core==5.13.31053.0 numpy==2.4.6
cd "$folder"
cat > run.py <<'PYTHON'
import csv
import sys

import slicer
import vtk


def read(name, rows):
    with open(name, "w", newline="") as file:
        csv.writer(file).writerows(rows)
    scene = slicer.vtkMRMLScene()
    node = scene.AddNewNodeByClass("vtkMRMLTableNode")
    storage = scene.AddNewNodeByClass("vtkMRMLTableStorageNode")
    storage.SetFileName(name)
    code, table = storage.ReadData(node), node.GetTable()
    columns = range(table.GetNumberOfColumns())
    return code, [[table.GetValue(row, column).ToString() for column in columns] for row in range(table.GetNumberOfRows())]


quotes = read("quotes.csv", [["a", "b"], ["1", 'say "hi" now'], ["2", "q"]])
breaks = read("breaks.csv", [["a", "b"], ["1", "line\nbreak"], ["2", "q"]])
plain = read("plain.csv", [["a", "b"], ["1", "x,y"], ["2", "q"]])
print(f"VTK {vtk.VTK_VERSION}: quotes {quotes}, breaks {breaks}, comma {plain}")
found = quotes != (1, [["1", " now"], ["2", "q"]]) or breaks == (1, [["1", "line\nbreak"], ["2", "q"]])
sys.exit(found or plain != (1, [["1", "x,y"], ["2", "q"]]))
PYTHON
"$folder/venv/bin/python" run.py
