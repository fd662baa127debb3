"""The control loop: executes declared motions tick by tick within limits, and reports what really happened."""
