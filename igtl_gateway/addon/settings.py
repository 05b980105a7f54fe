"""Settings: rows of an add-on, the configuration of a gateway, and the choices that the core has."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.cli.settings import add_settings as add_settings
    from igtl_gateway.cli.settings import values_with_effect as values_with_effect
    from igtl_gateway.config.configuration import Config as Config
    from igtl_gateway.config.configuration import PeerRow as PeerRow
    from igtl_gateway.config.configuration import TfOutRow as TfOutRow
    from igtl_gateway.config.configuration import ToRosRow as ToRosRow
    from igtl_gateway.config.configuration import read_toml as read_toml
    from igtl_gateway.config.notations import DDS as DDS
    from igtl_gateway.config.notations import address as address
    from igtl_gateway.config.setting import HOST as HOST
    from igtl_gateway.config.setting import RECORD as RECORD
    from igtl_gateway.config.setting import ROS_GRAPH as ROS_GRAPH
    from igtl_gateway.config.setting import Setting as Setting
    from igtl_gateway.config.setting import grouped as grouped
    from igtl_gateway.convert.choices import AUTO as AUTO_PROFILE
    from igtl_gateway.edges.video.options import ENCODERS as ENCODERS
    from igtl_gateway.gateway.acceptance import DEFAULT_ACCEPTANCE as DEFAULT_ACCEPTANCE
    from igtl_gateway.gateway.acceptance import Acceptance as Acceptance

#: Names that are others there; the rest of the group is above.
__all__ = ["AUTO_PROFILE"]

HOMES: Homes = (
    # Rows, and their options
    ("config.setting", "HOST RECORD ROS_GRAPH Setting grouped"),
    ("config.notations", "DDS address"),
    ("cli.settings", "add_settings values_with_effect"),
    # The configuration, and what a gateway accepts
    ("config.configuration", "Config PeerRow TfOutRow ToRosRow read_toml"),
    ("gateway.acceptance", "Acceptance DEFAULT_ACCEPTANCE"),
    # Choices: profiles of peers, encoders of video
    ("convert.choices", "AUTO_PROFILE=AUTO"),
    ("edges.video.options", "ENCODERS"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
