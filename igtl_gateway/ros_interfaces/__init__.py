"""ROS 2 interface packages that no wheel brings: igtl_msgs, tf2_msgs, foxglove_msgs, rosbag2_interfaces.

After ``pip install "igtl-gateway[ros]"`` any program of that environment may say ``from igtl_msgs.msg import
TrackingData``.  Strategy:

* ``python/`` holds a stand-in for each package.  A ``.pth`` file puts that folder at the end of ``sys.path``,
  so that a real installation of the same package always wins.
* A stand-in that is imported sets its ``__path__`` to the compiled package (:mod:`.cache`).  What is not there
  yet is compiled first, once for the environment (:mod:`.build`, in a process of its own).
* The definitions of ``igtl_msgs`` are those of ``ros2/igtl_msgs`` in the source tree, where colcon builds them for
  an ordinary ROS 2; the others are in ``definitions/`` (:mod:`.definitions`).

``python -m igtl_gateway.ros_interfaces`` compiles all ahead of time.  Nothing here imports ROS: without one, the
gateway works and only these imports fail.
"""
