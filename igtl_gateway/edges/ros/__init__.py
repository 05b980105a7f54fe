"""The ROS 2 edge: rclpy's node on the DDS graph.  Nothing else imports rclpy."""
