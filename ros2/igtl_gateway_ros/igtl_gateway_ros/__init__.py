"""The executables of the ROS package igtl_gateway; the program is the Python distribution igtl-gateway."""
