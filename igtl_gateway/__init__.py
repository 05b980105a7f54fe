"""igtl-gateway: bridge between ROS 2 and OpenIGTLink, with recording, replay and verification."""

__version__ = "0.1.0"
