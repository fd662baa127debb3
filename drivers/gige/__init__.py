"""Cameras that speak GenICam over GigE Vision or USB3 Vision, through the Aravis library."""
