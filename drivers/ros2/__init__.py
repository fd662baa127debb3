"""Devices of a ROS 2 system, over rosbridge: an arm, a gripper, a force/torque sensor, and the connection that all use."""
