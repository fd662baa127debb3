"""Pose of four known points in one image: `estimate`, with covariance, mirror poses and an honest flag.

`three_point` gives the poses of three points, `minima` every minimum of `cost`,
`posterior` their odds; `search` joins them. All below `pose` is compiled.
"""

from perception.vision.quadrangle.pose import AlternativePose, QuadranglePose, estimate, warm_up

__all__ = ["AlternativePose", "QuadranglePose", "estimate", "warm_up"]
