"""The ROS side over Zenoh, in the format of rmw_zenoh and without ROS.  ``edge`` has the interface of ``edges.ros``.

Only this package imports zenoh; ``names`` has the formats and needs no session.
"""
