"""A synthetic suturing scene in the manner of the Smart Tissue Autonomous Robot (STAR): geometry as arrays.

Everything here is **synthetic**: no patient, no animal, no file; formulas and a seed make it.  A bowel-like
tube of 15 mm radius with folds and a 30 mm incision lies 250 mm under a light-field camera, two further
loops and a cloth behind it.  A KUKA-LWR-like arm brings the needle to eleven planned stitches.

Ground truth stays reachable: ``Scene`` holds the true surface, the true plan and markers, and every
``CloudFrame`` its true points, so that a reviewer's tools can be judged against what really was there.
As on the real system, the plan is made from the noisy cloud; a wet spot that reads 2 mm too deep puts one
stitch beside the tissue until an operator corrects it (``measured_plan``, ``corrected_plan``).

Surfaces are distance functions (``star_tissue``), pictures are made by stepping along each pixel's ray
(``star_camera``), the arm follows the plan (``star_arm``).  Lengths are metres, angles radians, times seconds;
the camera frame is optical: x right, y down, z forward.  Same bytes everywhere, see ``star_numbers``.
"""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np

from igtl_gateway.simulate.star_arm import HOME, SHAFT, ToolPath, Waypoints, shaft_at, tool_path, waypoints
from igtl_gateway.simulate.star_camera import (
    CLOUD_CAMERA,
    IMAGE_CAMERA,
    Camera,
    CloudFrame,
    ToolView,
    View,
    draw_tool,
    measure,
    see,
    seven_bits,
)
from igtl_gateway.simulate.star_numbers import SEED, Array, Noise, Rgb, rounded
from igtl_gateway.simulate.star_tissue import FOCUS_M, WET_STITCH, Plan, true_markers, true_plan

MARKER_STEP_M = 2.0**-20  #: positions of markers and stitches are multiples of this


class Scene:
    """The whole synthetic scene of one seed.  Everything is computed on demand and equal on every call.

    Attributes:
        plan: the true plan, on the true surface.
        markers: the true centres of the six glue dots that shine in the near infrared.
    """

    def __init__(self, seed: int = SEED) -> None:
        self._seed = seed
        self.plan = true_plan()
        self.markers = true_markers()
        self._start = self.plan.entry[0] + HOME

    @property
    def cloud_view(self) -> View:
        """The undisturbed scene in the pixels of the depth camera."""
        return _undisturbed(CLOUD_CAMERA)

    @property
    def image_view(self) -> View:
        """The undisturbed scene in the pixels of the colour camera."""
        return _undisturbed(IMAGE_CAMERA)

    def cloud(self, number: int, time_s: float) -> CloudFrame:
        """Shot ``number`` of the depth camera, with the tool where it is at ``time_s``."""
        return self._measure(number, self._tool_in_view(self.cloud_view, time_s))

    def image(self, number: int, time_s: float) -> Rgb:
        """Picture ``number`` of the colour camera, (240, 320, 3), with the tool where it is at ``time_s``."""
        view = self.image_view
        rgb = self._tool_in_view(view, time_s).over(view.rgb)
        return seven_bits(rgb + 0.002 * Noise(self._seed, 2, number).normal(*rgb.shape))

    def detected_markers(self, number: int) -> Array:
        """Marker positions as found in the near-infrared picture ``number``: (6, 3), error mostly along the ray."""
        noise = Noise(self._seed, 3, number)
        across = 0.00005 * noise.normal(*self.markers.shape)
        along = 0.00015 * noise.normal(len(self.markers), 1) * self.markers / FOCUS_M
        return rounded(self.markers + across + along, MARKER_STEP_M)

    @cached_property
    def measured_plan(self) -> Plan:
        """The plan as drawn in the picture and lifted by the first cloud: one stitch misses the tissue."""
        frame = self._measure(0, draw_tool(self.cloud_view, self._start, SHAFT))
        return Plan(_lift(frame, self.plan.entry), _lift(frame, self.plan.exit))

    @cached_property
    def corrected_plan(self) -> Plan:
        """The measured plan after the operator has put the stray exit point back on the tissue."""
        exit_points = self.measured_plan.exit.copy()
        exit_points[WET_STITCH] = rounded(self.plan.exit[WET_STITCH], MARKER_STEP_M)
        return Plan(self.measured_plan.entry, exit_points)

    def tool(self, times: Array) -> ToolPath:
        """Where the arm holds the needle tip, in the base frame, ``times`` seconds after the start.

        Each stitch of the corrected plan takes ``CYCLE_S``.
        """
        return tool_path(self._waypoints(times), times, Noise(self._seed, 4))

    def _waypoints(self, times: Array) -> Waypoints:
        return waypoints(self._start, self.corrected_plan, times)

    def _tool_in_view(self, view: View, time_s: float) -> ToolView:
        way = self._waypoints(np.array([time_s]))
        return draw_tool(view, way.tip[0], shaft_at(way.roll[0]))

    def _measure(self, number: int, tool: ToolView) -> CloudFrame:
        noise = Noise(self._seed, 1, number)
        return measure(self.cloud_view, tool, self.plan.exit[WET_STITCH], noise)


@cache
def _undisturbed(camera: Camera) -> View:
    """The same for all seeds, and the slow part: kept, and so not to be written to."""
    view = see(camera, true_markers(), true_plan().exit[WET_STITCH])
    for array in vars(view).values():
        array.flags.writeable = False
    return view


def _lift(frame: CloudFrame, points: Array) -> Array:
    """Points drawn in the picture, at the median depth of the 5 by 5 pixels around them."""
    lifted = []
    for pixel, point in zip(CLOUD_CAMERA.project(points), points, strict=True):
        column, row = (int(value) for value in np.rint(pixel))
        depth = np.nanmedian(frame.points[row - 2 : row + 3, column - 2 : column + 3, 2].astype(np.float64))
        lifted.append(point / point[2] * depth)
    return rounded(np.array(lifted), MARKER_STEP_M)
