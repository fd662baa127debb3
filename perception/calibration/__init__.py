"""Calibration of camera, hand, range scanner and wrist sensor, each with covariance."""
