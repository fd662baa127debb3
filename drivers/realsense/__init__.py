"""RealSense depth cameras, live or from a recording, through librealsense (extra `realsense`)."""
