"""OpenIGTLink messages ⇄ ROS 2 messages: pure functions over values, one table of conversions."""
