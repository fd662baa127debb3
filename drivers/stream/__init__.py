"""Network cameras: MJPEG over HTTP, RTSP, and ONVIF devices, which tell the address of their stream."""
