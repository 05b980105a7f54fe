"""The ROS 2 edge: a node on the DDS graph.  ``edge`` is its interface; ``middleware`` alone imports rclpy."""
