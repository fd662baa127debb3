"""Robust fusion: `fuse` computes a pose from measurements, some of which may be wrong (paper IV).

`search` draws subsets, `minima` refines what they find, `evidence` tests whether agreement may be chance, and `answer`
reports the result; `inliers` proves a set optimal, `with_shape` also estimates an object's dimensions.
"""

from fusion.robust.answer import Alternative, FusedPose, Rejected, ShapeEstimate
from fusion.robust.entry import fuse, used_entries

__all__ = ["Alternative", "FusedPose", "Rejected", "ShapeEstimate", "fuse", "used_entries"]
