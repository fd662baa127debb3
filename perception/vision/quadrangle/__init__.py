"""Pose of four known points in one image: `estimate`, with covariance, mirror poses and an ambiguity flag.

`three_point` gives the poses of three points, `minima` every minimum of `cost`, `posterior` their odds, and `search`
combines them. All modules below `pose` are compiled.
"""

from perception.vision.quadrangle.pose import AlternativePose, QuadranglePose, estimate, warm_up

__all__ = ["AlternativePose", "QuadranglePose", "estimate", "warm_up"]
