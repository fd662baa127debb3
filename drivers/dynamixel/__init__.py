"""Dynamixel servos on one bus: an arm, a gripper, and the client and packets that both speak with (protocol 2.0)."""
