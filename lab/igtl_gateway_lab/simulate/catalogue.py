"""The scenarios by name."""

from __future__ import annotations

from igtl_gateway.config.configuration import Config
from igtl_gateway_lab.simulate import (
    acquisition,
    brain,
    crtk,
    dummies,
    every_type,
    lego,
    paper_types,
    star,
    star_topics,
    traffic,
    ultrasound,
)
from igtl_gateway_lab.simulate.load import Load
from igtl_gateway_lab.simulate.scenario import Scenario

SCENARIOS = {
    "star": Scenario(star.TITLE, star_topics.CONFIG, actors=star.actors),
    "paper-types": Scenario(
        "one message of each type of the ROS-IGTL-Bridge paper, in both directions, synthetic",
        Config(),
        lambda _duration_s: paper_types.inputs(),
    ),
    "every-type": Scenario(
        "every row of the conversion table, every query, commands, tf chains, metadata and kinds of peers, synthetic",
        every_type.CONFIG,
        lambda _duration_s: every_type.inputs(),
    ),
    "lego": Scenario(
        "a toy arm is registered to an MR head by touch and draws a line planned on it (the paper's 4.1), synthetic",
        lego.CONFIG,
        actors=lego.actors,
    ),
    "acquisition": Scenario(
        "a planner has a robot initialised, moved to a point and acquire an image (the paper's Figure 9), synthetic",
        acquisition.CONFIG,
        actors=acquisition.actors,
    ),
    "test-node": Scenario(
        "a transform, a point, a cloud, a string and a model, each way (the paper's ROS-IGTL-Test node), synthetic",
        dummies.CONFIG,
        actors=dummies.actors,
    ),
    "test-server": traffic.scenario(Load()),
    "brain": Scenario(
        "a brain surface of 700,000 points and 240,000 faces there and back; below 5 s a small synthetic one",
        brain.CONFIG,
        actors=brain.actors,
    ),
    "crtk": Scenario(crtk.TITLE, crtk.CONFIG, actors=crtk.actors),
    "ultrasound": Scenario(
        "a tracked freehand sweep over a phantom of vessel and bone, pieced together on the ROS side, synthetic",
        ultrasound.CONFIG,
        actors=ultrasound.actors,
    ),
}
