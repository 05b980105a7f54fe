"""OpenIGTLink → ROS, in the order of the traffic: receive, route, convert."""
