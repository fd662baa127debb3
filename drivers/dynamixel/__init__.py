"""Dynamixel servos on one bus: an arm, a gripper, and the client and packets that both use (protocol 2.0)."""
