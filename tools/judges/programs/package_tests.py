"""Runs the tests of a package with pytest, publishes each outcome with its session time, and waits for the end.

It has a context of its own, because tests initialise and shut down the default one.
"""

import sys
import time

import pytest
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import String

context = rclpy.Context()
rclpy.init(context=context)
node = rclpy.create_node("package_tests", context=context)
publisher = node.create_publisher(String, "/tests", 1000)
executor = SingleThreadedExecutor(context=context)
executor.add_node(node)
begin = time.monotonic()


class Outcomes:
    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.outcome != "passed":
            name = report.nodeid.partition("::")[2]
            why = str(report.longrepr).splitlines()[-1] if report.failed else ""
            publisher.publish(String(data=f"{report.outcome} {name} at {time.monotonic() - begin:.9f} {why}"))


pytest.main(["-q", "-p", "no:cacheprovider", *sys.argv[1:]], plugins=[Outcomes()])
try:
    executor.spin()
except (KeyboardInterrupt, ExternalShutdownException):
    pass
