"""igtl-gateway: ROS 2 and OpenIGTLink, bridged, recorded, replayed, verified."""

__version__ = "0.1.0"
