"""Pose of four known points in one image: `estimate`, with covariance, mirror poses and an ambiguity flag.

`three_point` computes the poses of three points, `minima` finds every local minimum of `cost`, and `posterior` computes the
probability of a mirror pose. These modules are compiled; `pose` combines them.
"""

from perception.vision.quadrangle.pose import AlternativePose, QuadranglePose, estimate, warm_up

__all__ = ["AlternativePose", "QuadranglePose", "estimate", "warm_up"]
