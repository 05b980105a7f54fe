#!/bin/sh
# trame-slicer: a scene with a sequence browser is read without the browser, and without a line in the log.
#
# Expected: SlicerApp reads a scene that it has written, all nodes of it.  Guess before the run: the browser is there.
# Found: load_scene returns 0 and keeps the sequences, but not the browser that plays them, because the application
#        has no logic of sequences.  trame-slicer's own viewer does not look at the 0.  After
#        register_module_logic(vtkSlicerSequencesLogic()) the browser is there.  In both cases the sequence of transforms
#        "Poses" is "Poses-Poses-Seq" after the reading.
# Versions: trame-slicer 2.0.0, slicer-core 5.11.0.6, slicer-layer-dm 2.0.0, VTK 9.6.0.
# Concerns: who shows recorded scenes of 3D Slicer in the browser, and who finds sequences by their names.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check "trame-slicer[standalone]==2.0.0" \
    slicer-core==5.11.0.6 slicer-layer-dm==2.0.0 vtk==9.6.0 2> "$folder/pip.txt" || { cat "$folder/pip.txt"; exit 1; }
cd "$folder"
cat > make.py <<'PYTHON'
import slicer
from trame_slicer.core import SlicerApp
from vtkmodules.vtkCommonMath import vtkMatrix4x4

app = SlicerApp()
app.register_module_logic(slicer.vtkSlicerSequencesLogic())
sequence = app.scene.AddNewNodeByClass("vtkMRMLSequenceNode", "Poses")
tool = app.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Tool")
for second in range(3):
    matrix = vtkMatrix4x4()
    matrix.SetElement(0, 3, float(second))
    tool.SetMatrixTransformToParent(matrix)
    sequence.SetDataNodeAtValue(tool, str(second))
app.scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "Session").AddSynchronizedSequenceNode(sequence)
assert app.io_manager.save_scene("session.mrb")
PYTHON
cat > read.py <<'PYTHON'
import sys
import slicer
from trame_slicer.core import SlicerApp

app = SlicerApp()
if sys.argv[1] == "with":
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
done = app.io_manager.load_scene("session.mrb")
names = [node.GetName() for node in app.scene.GetNodesByClass("vtkMRMLSequenceNode")]
browsers = app.scene.GetNumberOfNodesByClass("vtkMRMLSequenceBrowserNode")
print(f"{sys.argv[1]} the logic: returned {int(done)}, browsers {browsers}, sequences {names}")
PYTHON
"$folder/venv/bin/python" make.py > /dev/null 2>&1
for logic in without with; do
    "$folder/venv/bin/python" read.py "$logic" 2> "log-$logic.txt" | tee -a out.txt
    echo "lines of the log: $(grep -c . "log-$logic.txt" || true)"
done
test ! -s log-without.txt
grep -q "^without the logic: returned 0, browsers 0, sequences \['Poses-Poses-Seq'\]" out.txt
grep -q "^with the logic: returned 1, browsers 1, sequences \['Poses-Poses-Seq'\]" out.txt
