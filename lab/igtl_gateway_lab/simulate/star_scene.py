"""A synthetic suturing scene in the manner of the Smart Tissue Autonomous Robot (STAR): geometry as arrays.

Everything here is **synthetic**: no patient, no animal, no file; formulas and a seed make it.  A bowel-like
tube of 15 mm radius with folds and a 30 mm incision lies 250 mm under a light-field camera, two further
loops and a cloth behind it.  A KUKA-LWR-like arm brings the needle to eleven planned stitches.

Ground truth stays reachable: ``StarScene`` holds the true surface, the true plan and markers, and every
``CloudFrame`` its true points, so that a reviewer's tools can be judged against what really was there.
As on the real system, the plan is drawn in the picture and gets its depth from one noisy cloud.  Two errors
are planted (``PLANTED``): a glint in that first cloud lifts one stitch 2 mm off the tissue, and a wet spot,
which reads too deep in every cloud, sinks another by as much.  The picture shows neither.

Surfaces are distance functions (``star_tissue``), pictures are made by stepping along each pixel's ray
(``star_camera``), the arm follows the plan (``star_arm``).  Lengths are metres, angles radians, times seconds;
the camera frame is optical: x right, y down, z forward.  Same bytes everywhere, see ``star_numbers``.
"""

from __future__ import annotations

import math
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from igtl_gateway_lab.simulate.star_arm import HOME, SHAFT, ToolPath, tool_path, waypoints
from igtl_gateway_lab.simulate.star_camera import (
    CLOUD_CAMERA,
    IMAGE_CAMERA,
    Camera,
    CloudFrame,
    View,
    depth_shot,
    draw_tool,
    glare,
    render_view,
    seven_bits,
    shine,
)
from igtl_gateway_lab.simulate.star_numbers import SEED, Array, Noise, Rgb, rounded
from igtl_gateway_lab.simulate.star_tissue import (
    FOCUS_M,
    GLINT_ERROR_M,
    GLINT_STITCH,
    WET_ERROR_M,
    WET_STITCH,
    SuturePlan,
    true_markers,
    true_plan,
)

MARKER_STEP_M = 2.0**-20  #: positions of markers and stitches are multiples of this
NEVER_S = math.inf


class StarScene:
    """The whole synthetic scene of one seed.  Everything is computed on demand and equal on every call.

    Attributes:
        plan: the true plan, on the true surface.
        markers: the true centres of the six glue dots that shine in the near infrared.
        rest: the needle's tip as long as the arm waits, camera frame.
    """

    def __init__(self, seed: int = SEED) -> None:
        self._seed = seed
        self.plan = true_plan()
        self.markers = true_markers()
        self.rest: Array = self.plan.entry[0] + HOME

    @property
    def cloud_view(self) -> View:
        """The undisturbed scene in the pixels of the depth camera."""
        return _undisturbed(CLOUD_CAMERA)

    @property
    def image_view(self) -> View:
        """The undisturbed scene in the pixels of the colour camera."""
        return _undisturbed(IMAGE_CAMERA)

    def look(self) -> None:
        """Have both views ready: seconds of work, once."""
        for camera in (CLOUD_CAMERA, IMAGE_CAMERA):
            _undisturbed(camera)

    def cloud(self, number: int, tip: Array, shaft: Array) -> CloudFrame:
        """Shot ``number`` of the depth camera, with the tool where it is (tip, direction up the shaft)."""
        view = self.cloud_view
        spots = [(self.plan.exit[WET_STITCH], WET_ERROR_M)]
        if number == 0:
            spots.append((self._glint, GLINT_ERROR_M))
        tool = draw_tool(view, tip, shaft)
        return depth_shot(view, self._colours(number, view), tool, spots, Noise(self._seed, 1, number))

    def image(self, number: int, tip: Array, shaft: Array) -> Rgb:
        """Picture ``number`` of the colour camera, (240, 320, 3), with the tool where it is."""
        view = self.image_view
        rgb = draw_tool(view, tip, shaft).over(self._colours(number, view))
        return seven_bits(rgb + 0.002 * Noise(self._seed, 2, number).normal(*rgb.shape))

    def detected_markers(self, number: int) -> Array:
        """Marker positions as found in the near-infrared picture ``number``: (6, 3), error mostly along the ray."""
        noise = Noise(self._seed, 3, number)
        across = 0.00005 * noise.normal(*self.markers.shape)
        along = 0.00015 * noise.normal(len(self.markers), 1) * self.markers / FOCUS_M
        return rounded(self.markers + across + along, MARKER_STEP_M)

    @cached_property
    def measured_plan(self) -> SuturePlan:
        """The plan as drawn in the picture and lifted by the first cloud: the stitches ``PLANTED`` miss the tissue."""
        return lifted(self.plan, self.cloud(0, self.rest, SHAFT).points)

    def tool(self, times: Array, plan: SuturePlan, begin_s: float = NEVER_S) -> ToolPath:
        """Where the arm holds the needle tip, in the base frame, at ``times`` of the session.

        Without motion until ``begin_s``; from then on each stitch of ``plan`` takes ``CYCLE_S``.
        """
        return tool_path(waypoints(self.rest, plan, times - begin_s), times, Noise(self._seed, 4))

    @property
    def _glint(self) -> Array:
        return np.asarray(self.plan.entry[GLINT_STITCH])

    def _colours(self, number: int, view: View) -> Array:
        if number:
            return view.rgb
        return np.clip(view.rgb + glare(shine(view.rays * view.depth[..., None], self._glint)), 0, 1)


@cache
def _undisturbed(camera: Camera) -> View:
    """The same for all seeds, and the slow part: kept, and so not to be written to."""
    view = render_view(camera, true_markers(), true_plan().exit[WET_STITCH])
    for array in vars(view).values():
        array.flags.writeable = False
    return view


def lifted(drawn: SuturePlan, cloud: NDArray[np.float32]) -> SuturePlan:
    """A plan drawn in the picture, at the depths of an organised cloud of ``CLOUD_CAMERA``."""
    return SuturePlan(_lift(drawn.entry, cloud), _lift(drawn.exit, cloud))


def _lift(points: Array, cloud: NDArray[np.float32]) -> Array:
    """Points at the median depth of the 5 by 5 pixels around them."""
    found = []
    for pixel, point in zip(CLOUD_CAMERA.project(points), points, strict=True):
        column, row = (int(value) for value in np.rint(pixel))
        depth = np.nanmedian(cloud[row - 2 : row + 3, column - 2 : column + 3, 2].astype(np.float64))
        found.append(point / point[2] * depth)
    return rounded(np.array(found), MARKER_STEP_M)
