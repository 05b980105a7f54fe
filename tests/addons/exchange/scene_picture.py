"""Draws a scene with the displayable managers of 3D Slicer (slicer-core): the pictures ``docs/pictures/slicer-*.png``.

VTK_DEFAULT_OPENGL_WINDOW=vtkEGLRenderWindow python -m tests.addons.exchange.scene_picture SCENE OUT.png ITEM
"""

from __future__ import annotations

import sys
from pathlib import Path

import slicer
import vtk

from tests.addons.exchange.scene_judge import opened


def main(scene_file: Path, out: str, item: int) -> None:
    scene, logic = opened(scene_file)
    browser = scene.GetFirstNodeByClass("vtkMRMLSequenceBrowserNode")
    browser.SetSelectedItemNumber(item)
    logic.UpdateProxyNodesFromSequences(browser)
    window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
    window.SetOffScreenRendering(1)
    window.SetSize(900, 700)
    renderer.SetBackground(0.757, 0.765, 0.91)
    renderer.SetBackground2(0.455, 0.471, 0.745)
    renderer.GradientBackgroundOn()
    window.AddRenderer(renderer)
    interactor = vtk.vtkRenderWindowInteractor()
    interactor.SetRenderWindow(window)
    application, group = slicer.vtkMRMLApplicationLogic(), slicer.vtkMRMLDisplayableManagerGroup()
    application.SetMRMLScene(scene)
    group.SetRenderer(renderer)
    for manager in (slicer.vtkMRMLCameraDisplayableManager(), slicer.vtkMRMLModelDisplayableManager()):
        manager.SetMRMLApplicationLogic(application)
        group.AddDisplayableManager(manager)
    group.SetMRMLDisplayableNode(scene.GetFirstNodeByClass("vtkMRMLViewNode"))
    window.Render()
    node, camera = scene.GetFirstNodeByClass("vtkMRMLCameraNode"), renderer.GetActiveCamera()
    camera.SetPosition(node.GetPosition())
    camera.SetFocalPoint(node.GetFocalPoint())
    camera.SetViewUp(node.GetViewUp())
    renderer.ResetCameraClippingRange()
    window.Render()
    shot, writer = vtk.vtkWindowToImageFilter(), vtk.vtkPNGWriter()
    shot.SetInput(window)
    writer.SetInputConnection(shot.GetOutputPort())
    writer.SetFileName(out)
    writer.Write()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
