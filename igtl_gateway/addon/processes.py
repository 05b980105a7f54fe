"""What an installation has, and programs in processes of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igtl_gateway.addon.loading import Homes, at_first_use

if TYPE_CHECKING:
    from igtl_gateway.base import extras as extras
    from igtl_gateway.base.addons import ADDONS as ADDONS
    from igtl_gateway.base.addons import check_present as check_present
    from igtl_gateway.base.addons import is_present as is_present
    from igtl_gateway.base.addons import part_of as part_of
    from igtl_gateway.base.child import Child as Child
    from igtl_gateway.base.child import report_facts as report_facts
    from igtl_gateway.base.extras import missing as missing
    from igtl_gateway.base.once import Once as Once
    from igtl_gateway.base.systems.leaving import expect_threads_of as expect_threads_of
    from igtl_gateway.base.systems.processes import KILL as KILL
    from igtl_gateway.base.systems.processes import end_session as end_session
    from igtl_gateway.base.systems.processes import is_program as is_program
    from igtl_gateway.base.systems.processes import limit_data as limit_data
    from igtl_gateway.base.systems.processes import lower_priority as lower_priority
    from igtl_gateway.base.systems.processes import stand_back as stand_back
    from igtl_gateway.base.systems.processes import ticks_per_second as ticks_per_second
    from igtl_gateway.base.systems.processes import usable_cpus as usable_cpus
    from igtl_gateway.base.systems.signals import endings_held as endings_held
    from igtl_gateway.base.systems.signals import ignore_endings as ignore_endings
    from igtl_gateway.edges.ros_interfaces.cache import make_ready as make_ready

HOMES: Homes = (
    # Extras and other add-ons
    ("base", "extras"),
    ("base.extras", "missing"),
    ("base.addons", "ADDONS check_present is_present part_of"),
    # Other processes: their start, their end and their share of the host
    ("base.child", "Child report_facts"),
    (
        "base.systems.processes",
        "KILL end_session is_program limit_data lower_priority stand_back ticks_per_second usable_cpus",
    ),
    ("base.systems.signals", "endings_held ignore_endings"),
    # What programs of ROS need, before they start
    ("edges.ros_interfaces.cache", "make_ready"),
    # Once in a process, and threads that outlive it
    ("base.once", "Once"),
    ("base.systems.leaving", "expect_threads_of"),
)

__getattr__, __dir__ = at_first_use(__name__, HOMES)
