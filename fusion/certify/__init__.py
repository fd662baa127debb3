"""Proof that no other pose fits better: `certificate`.

`lifted` writes the error as one quadratic form, `dual` finds multipliers that prove its minimum from the pose itself,
and if they do not exist, `relaxation` solves the semidefinite problem.
"""

from fusion.certify.proof import Certificate, certificate

__all__ = ["Certificate", "certificate"]
