"""Geometry of the arm: forward and inverse kinematics of its chain of joints."""
