"""ROS 2 interface packages for which no wheel exists: igtl_msgs, tf2_msgs, foxglove_msgs, crtk_msgs ….

After ``pip install "igtl-gateway[ros]"`` each program of this environment can execute ``from igtl_msgs.msg import
TrackingData``.  Strategy:

* ``python/`` contains a stand-in for each package.  A ``.pth`` file adds this folder to the end of ``sys.path``, so a
  real installation of the same package takes precedence.
* When a stand-in is imported, it sets its ``__path__`` to the compiled package (:mod:`.cache`).  The package is
  compiled before the first node starts, or at its first import, once for the environment (:mod:`.compiling`).
* The definitions of ``igtl_msgs`` are those of ``ros2/igtl_msgs`` in the source tree, which colcon builds for an
  ordinary ROS 2 installation.  The others are in ``igtl_gateway/convert/interfaces``.

``python -m igtl_gateway.edges.ros_interfaces`` compiles all packages ahead of time.  Nothing here imports ROS: without
ROS the gateway works, and only the imports of these packages fail.
"""
