"""ROS → OpenIGTLink, in the order of the traffic: receive, compose, latest, deliver."""
