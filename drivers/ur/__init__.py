"""Universal Robots controller over RTDE: the arm, the digital inputs and outputs, and the session that both use."""
