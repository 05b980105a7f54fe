"""Shows a scene that `igtl-gateway export --to mrb` has made in the browser, and plays it: docs/how-to/slicer.md."""

from __future__ import annotations

import asyncio

from slicer import vtkSlicerSequencesLogic
from trame.app import TrameApp
from trame.decorators import change
from trame.ui.vuetify3 import SinglePageLayout
from trame.widgets import vuetify3 as vuetify
from trame_slicer import module as trame_slicer_module
from trame_slicer.core import LayoutManager, SlicerApp
from trame_slicer.rca_view import register_rca_factories
from trame_slicer.views import Layout, LayoutDirection, ViewLayoutDefinition

REFRESH_S = 0.04


class SceneInBrowser(TrameApp):
    def __init__(self) -> None:
        super().__init__()
        self.server.enable_module(trame_slicer_module)
        self.server.cli.add_argument("scene", help="a file .mrb, or the .mrml of a directory")
        options, _ = self.server.cli.parse_known_args()

        self.app = SlicerApp()
        scene = self.app.scene
        # Without this logic the scene drops its sequence browser.
        self.sequences = self.app.register_module_logic(vtkSlicerSequencesLogic())
        register_rca_factories(self.app.view_manager, self.server)
        layouts = LayoutManager(scene, self.app.view_manager, self.server)
        slices = [
            ViewLayoutDefinition.axial_view(),
            ViewLayoutDefinition.coronal_view(),
            ViewLayoutDefinition.sagittal_view(),
        ]
        three_d = ViewLayoutDefinition.threed_view()
        layouts.register_layout(
            "scene", Layout(LayoutDirection.Horizontal, [three_d, Layout(LayoutDirection.Vertical, slices)])
        )
        layouts.set_layout("scene")

        if not self.app.io_manager.load_scene(options.scene):
            raise SystemExit(f"found no scene in {options.scene}")
        # The scene's camera belongs to the view "1" of 3D Slicer; trame-slicer needs names that JavaScript can have.
        saved = next(camera for camera in scene.GetNodesByClass("vtkMRMLCameraNode") if camera.GetLayoutName() == "1")
        (view,) = self.app.view_manager.get_threed_views()
        view.renderer().GetActiveCamera().DeepCopy(saved.GetCamera())
        self.browser = scene.GetFirstNodeByClass("vtkMRMLSequenceBrowserNode")
        if not self.browser:
            raise SystemExit(f"found no sequence browser in {options.scene}")
        self.state.update({"item": 0, "items": self.browser.GetNumberOfItems(), "playing": False})

        with SinglePageLayout(self.server) as page:
            page.title.set_text("igtl-gateway scene")
            with page.toolbar:
                vuetify.VBtn(icon=("playing ? 'mdi-pause' : 'mdi-play'",), click="playing = !playing", id="play")
                vuetify.VSlider(v_model=("item",), min=0, max=("items - 1",), step=1, hide_details=True)
                vuetify.VLabel("{{ index }} s", classes="mx-4")
            with page.content, vuetify.VContainer(fluid=True, classes="pa-0 fill-height"):
                layouts.initialize_layout_grid(page)

    @change("item")
    def select(self, item: int, **_: object) -> None:
        if item != self.browser.GetSelectedItemNumber():
            self.browser.SetSelectedItemNumber(int(item))
        self.sequences.UpdateProxyNodesFromSequences(self.browser)
        self.state.index = self.browser.GetMasterSequenceNode().GetNthIndexValue(int(item))

    @change("playing")
    async def play(self, **_: object) -> None:
        self.browser.SetPlaybackActive(self.state.playing)
        while self.state.playing:
            self.sequences.UpdateAllProxyNodes()
            with self.state:
                self.state.item = self.browser.GetSelectedItemNumber()
            await asyncio.sleep(REFRESH_S)


if __name__ == "__main__":
    SceneInBrowser().server.start()
