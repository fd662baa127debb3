"""From measurements, some of them wrong, to a pose that says what it knows (paper IV, issue 3): `fuse`.

`search` draws subsets, `minima` ends what they find, `evidence` asks whether agreement may be chance, `answer` says it all;
`inliers` proves a set best, `with_shape` estimates an object's measures too, `incremental` adds and takes single measurements.
"""

from fusion.robust.answer import Alternative, FusedPose, Rejected, ShapeEstimate
from fusion.robust.entry import fuse, used_entries

__all__ = ["Alternative", "FusedPose", "Rejected", "ShapeEstimate", "fuse", "used_entries"]
