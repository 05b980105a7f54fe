"""The ROS services of a player, with the names and types of the services of ``ros2 bag play``."""

from __future__ import annotations

import threading
from typing import Any

from igtl_gateway.app.player import Player
from igtl_gateway.base.errors import RosError
from igtl_gateway.base.stamp import ros_to_ns
from igtl_gateway.edges.ros.edge import RosEdge

PACKAGE = "rosbag2_interfaces"


class PlayerServices:
    """Answers the calls, each in a thread of the ROS edge."""

    def __init__(self, player: Player) -> None:
        self._player = player
        self._offering = threading.Lock()
        self._closed = False

    def serve(self, edge: RosEdge) -> str:
        """Create all services; return ``""``, or the reason why that is not possible.

        Call this in a separate thread: it might have to compile the service types first, which takes long.
        """
        try:
            edge.message_class(f"{PACKAGE}/srv/Pause")
        except RosError as error:
            return str(error)
        offered = {
            "pause": ("Pause", self.pause),
            "resume": ("Resume", self.resume),
            "toggle_paused": ("TogglePaused", self.toggle_paused),
            "is_paused": ("IsPaused", self.is_paused),
            "seek": ("Seek", self.seek),
            "play_next": ("PlayNext", self.play_next),
            "burst": ("Burst", self.burst),
            "set_rate": ("SetRate", self.set_rate),
            "get_rate": ("GetRate", self.get_rate),
        }
        with self._offering:
            for name, (kind, answer) in offered.items():
                if self._closed:
                    break
                if not edge.serve(f"~/{name}", f"{PACKAGE}/srv/{kind}", answer):
                    return f"~/{name} is refused"
        return ""

    def close(self) -> None:
        """Create no further services: the edge is about to stop."""
        with self._offering:
            self._closed = True

    def pause(self, _request: Any, response: Any) -> Any:
        self._player.pause()
        return response

    def resume(self, _request: Any, response: Any) -> Any:
        self._player.resume()
        return response

    def toggle_paused(self, _request: Any, response: Any) -> Any:
        self._player.toggle()
        return response

    def is_paused(self, _request: Any, response: Any) -> Any:
        response.paused = self._player.paused
        return response

    def seek(self, request: Any, response: Any) -> Any:
        """Seek to a recorded time, even if the messages are sent with new stamps."""
        response.success = self._player.seek(ros_to_ns(request.time.sec, request.time.nanosec))
        return response

    def play_next(self, _request: Any, response: Any) -> Any:
        response.success = self._player.burst(1) == 1
        return response

    def burst(self, request: Any, response: Any) -> Any:
        response.actually_burst = self._player.burst(request.num_messages)
        return response

    def set_rate(self, request: Any, response: Any) -> Any:
        response.success = self._player.set_rate(request.rate)
        return response

    def get_rate(self, _request: Any, response: Any) -> Any:
        rate = self._player.rate
        response.rate = float("inf") if rate is None else rate
        return response
