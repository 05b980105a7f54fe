"""The only places that touch the live world: sockets and ROS."""
