"""A Universal Robots controller over RTDE: the arm, its digital inputs and outputs, and the session that both hold."""
