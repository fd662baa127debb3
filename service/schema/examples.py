"""Example bodies of the verb `fuse`: the nine kinds of sensing, and an object with unknown dimensions."""

from __future__ import annotations

from typing import Any

from pydantic import JsonValue

_MM2, _TILT = 1e-6, 1e6  # the variance of 1 mm, and the information of 1 mrad


def _diagonal(x: float, y: float, z: float) -> list[list[float]]:
    return [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]


NINE_KINDS: dict[str, Any] = {
    "measurements": [
        {"sensing": "point-point", "x_m": [0.05, 0.05, 0.0], "mu_m": [0.55, 0.15, 0.3], "c_m2": _diagonal(_MM2, _MM2, _MM2),
         "label": "light seen in stereo", "sensor": "stereo"},
        {"sensing": "point-line", "x_m": [0.4, 0.0, 0.0], "u": [1.0, 0.0, 0.0], "mu_m": [0.8, 0.1, 0.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "label": "touch on the lower edge", "sensor": "touch"},
        {"sensing": "point-plane", "x_m": [0.4, 0.25, 0.0], "u": [0.0, 0.0, 1.0], "mu_m": [0.7, 0.4, 0.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "label": "touch on the front", "sensor": "touch"},
        {"sensing": "line-point", "x_m": [0.75, 0.45, 0.0], "mu_m": [1.25, 0.55, 1.3], "c_m2": _diagonal(_MM2, _MM2, _MM2),
         "m_per_rad2": _diagonal(_TILT, _TILT, 0.0), "label": "light seen by one camera", "sensor": "camera"},
        {"sensing": "line-line", "x_m": [0.0, 0.25, 0.0], "u": [0.0, 1.0, 0.0], "mu_m": [0.5, 0.35, 0.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "m_per_rad2": _diagonal(1e4, 0.0, 1e4), "label": "left edge in stereo"},
        {"sensing": "line-plane", "x_m": [0.4, 0.25, 0.0], "u": [0.0, 0.0, 1.0], "mu_m": [0.9, 0.3, 0.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "m_per_rad2": _diagonal(0.0, 1e4, 1e4), "label": "light stripe"},
        {"sensing": "plane-point", "x_m": [0.0, 0.0, 0.0], "mu_m": [0.7, 0.3, 0.3], "c_m2": _diagonal(_MM2, _MM2, _MM2),
         "m_per_rad2": _diagonal(1e4, 1e4, 0.0), "label": "corner in the range plane", "sensor": "range"},
        {"sensing": "plane-line", "x_m": [0.4, 0.5, 0.0], "u": [1.0, 0.0, 0.0], "mu_m": [0.9, 0.6, 1.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "m_per_rad2": _diagonal(_TILT, 0.0, _TILT), "label": "upper edge in an image"},
        {"sensing": "plane-plane", "x_m": [0.4, 0.25, 0.0], "u": [0.0, 0.0, 1.0], "mu_m": [0.9, 0.35, 0.3],
         "c_m2": _diagonal(_MM2, _MM2, _MM2), "m_per_rad2": _diagonal(1e4, 1e4, 0.0), "label": "front in a range image"},
    ],
    "certify": True,
    "prove_set_within_s": 5.0,
}  # fmt: skip

ROUND_POST: dict[str, Any] = {
    "shape": {"kind": "cylinder", "radius_m": 0.025, "length_m": 0.1, "sigma_m": 0.02},
    "prior": {"translation_m": [0.7, 0.1, 0.4], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
              "covariance": [[(1e-4 if i == j else 0.0) for j in range(6)] for i in range(6)]},
    "measurements": [
        {"sensing": "point-plane", "part": part, "x_m": [0.0, 0.0, 0.0], "mu_m": place,
         "c_m2": _diagonal(4e-8, 4e-8, 4e-8), "label": f"touch on the {part}", "sensor": "touch"}
        for part, place in (
            ("wall", [0.73, 0.1, 0.45]), ("wall", [0.67, 0.1, 0.43]), ("wall", [0.7, 0.13, 0.47]), ("wall", [0.7, 0.07, 0.42]),
            ("wall", [0.7212, 0.1212, 0.49]), ("top", [0.71, 0.1, 0.51]), ("top", [0.69, 0.11, 0.51]),
            ("top", [0.7, 0.085, 0.51]),
        )
    ],
}  # fmt: skip

FUSE_EXAMPLES: list[JsonValue] = [NINE_KINDS, ROUND_POST, {"collect": True, "touches": 4}]
