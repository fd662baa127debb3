"""Slamtec RPLIDAR: the scanner, and its express scans."""
