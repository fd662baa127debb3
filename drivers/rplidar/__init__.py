"""Slamtec RPLIDAR: the scanner driver, and the decoding of express scans."""
