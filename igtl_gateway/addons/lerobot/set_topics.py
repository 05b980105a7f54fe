"""What a session that was a LeRobot data set states about its topics, so that a starting recipe gives the set back."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from igtl_gateway.addon import GatewayError
from igtl_gateway.addon.reading import Recording
from igtl_gateway.addon.untrusted import parse_json, shape
from igtl_gateway.addons.lerobot.recipe import FORMATS, Cuts, Feature, Recipe
from igtl_gateway.addons.lerobot.recipe_file import is_feature_name

#: Item of the session metadata.
ITEM = "lerobot_set"
_TEXT, _TOPIC = (
    shape.text,
    shape.fields({"feature": shape.text, "names": shape.list_of(shape.text)}, ("feature", "names")),
)
_SET = shape.fields(
    {"version": _TEXT, "robot_type": _TEXT, "topics": shape.map_of(_TOPIC)}, ("version", "robot_type", "topics")
)
#: Type of messages → the column with their numbers.
_NUMBERS = {"sensor_msgs/msg/JointState": "position"}


@dataclass(frozen=True, slots=True)
class SetTopics:
    """What a data set was.

    Attributes:
        version, robot_type: as info.json has them.
        topics: topic → its feature, and the names of its numbers.  The feature is "" for a topic that has only what
            another one, or a phase, has too.
    """

    version: str
    robot_type: str
    topics: Mapping[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)

    def facts(self) -> dict[str, str]:
        """Return the item of the session metadata."""
        topics = {topic: {"feature": name, "names": list(names)} for topic, (name, names) in self.topics.items()}
        content = {"version": self.version, "robot_type": self.robot_type, "topics": topics}
        return {ITEM: json.dumps(content, sort_keys=True)}

    @classmethod
    def of(cls, recording: Recording) -> SetTopics | None:
        """Return what a recording states; None if it was no data set, or states something else."""
        text = recording.session.get(ITEM, "")
        if not text:
            return None
        try:
            found: Any = parse_json(text, ITEM)
            _SET(found, ITEM)
        except GatewayError:
            return None
        topics = {topic: (each["feature"], tuple(each["names"])) for topic, each in found["topics"].items()}
        return cls(found["version"], found["robot_type"], topics)

    def defaults(self) -> Recipe:
        """Return a recipe with the settings of the set: one episode for each phase."""
        version = self.version if self.version in FORMATS else FORMATS[0]
        return Recipe(1, "x", format=version, robot_type=self.robot_type or "unknown", episodes=Cuts("marks"))

    def feature(self, topic: str, key: str, kind: str, columns: Iterable[str]) -> Feature | None:
        """Return the row that gives the feature of a topic back; None if no row does.

        Args:
            topic, key, kind: of the stream.
            columns: of its table.
        """
        name, names = self.topics.get(topic, ("", ()))
        if not is_feature_name(name):
            return None
        column = _NUMBERS.get(kind, "data" if kind.endswith("MultiArray") else "")
        if column and column in columns:
            return Feature(name, key, fields=(column,), names=names)
        return Feature(name, key, tolerance_ms=None) if kind == "std_msgs/msg/String" else Feature(name, key)
