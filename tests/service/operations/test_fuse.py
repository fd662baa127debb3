"""Tests of the verb `fuse` with measurements in the request: nine kinds, proofs, and objects of unknown dimensions."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from benchmarks.fusion_simulation import CODES, problem
from fusion.measurement import Measurement
from hal.errors import InvalidRequest
from service.jsonable import jsonable
from service.operations.sense import run_fuse
from service.schema.examples import FUSE_EXAMPLES, NINE_KINDS, ROUND_POST
from service.schema.fuse_request import FuseRequest


def fused(body: dict[str, Any]) -> dict[str, Any]:
    """Return the answer that a client gets; measurements in the request need no cell."""
    request = FuseRequest.model_validate_json(json.dumps(body))
    answer: dict[str, Any] = json.loads(json.dumps(jsonable(run_fuse(None, request))))
    return answer


def body_of(m: Measurement) -> dict[str, Any]:
    return {"sensing": m.cls.words, "x_m": m.x_m.tolist(), "u": m.u.tolist(), "mu_m": m.mu_m.tolist(),
            "c_m2": m.C_m2.tolist(), "m_per_rad2": m.M.tolist(), "label": m.label}  # fmt: skip


PRIOR = {
    "translation_m": [0.5, 0.0, 0.3],
    "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0],
    "covariance": (1e-4 * np.eye(6)).tolist(),
}


@pytest.mark.parametrize("example", FUSE_EXAMPLES, ids=["nine kinds", "round post", "collect"])
def test_every_example_of_the_schema_is_valid(example: dict[str, Any]) -> None:
    assert FuseRequest.model_validate_json(json.dumps(example)).model_dump() is not None
    assert example in FuseRequest.model_json_schema()["examples"]


def test_nine_kinds_are_fused_and_proven() -> None:
    pytest.importorskip("clarabel", reason="proofs are an extra")
    answer = fused(NINE_KINDS)
    assert len({m["sensing"] for m in answer["measurements"]}) == 9
    assert not answer["rejected"]
    assert answer["warnings"] == []
    assert answer["translation_m"] == pytest.approx([0.5, 0.1, 0.3], abs=0.005)
    assert answer["certificate"]["tight"]
    assert answer["proven_set"]["proven"]
    assert answer["proven_set"]["believed"] == list(range(9))


def test_a_radius_and_a_length_come_back_with_their_sigma() -> None:
    shape = fused(ROUND_POST)["shape"]
    assert shape["names"] == ["radius_m", "length_m"]
    assert shape["values"][0] == pytest.approx(0.03, abs=0.0005)
    assert 0.0 < shape["sigma"][0] < 0.0005


def test_any_feature_set_with_parameters_is_estimated() -> None:
    """Two plates with an unknown gap between them: touches on both give pose and gap."""
    gap_m, spread = 0.085, 0.1
    places = [(x, y) for x in (-spread, 0.0, spread) for y in (-spread, spread)]
    variance = (4e-8 * np.eye(3)).tolist()
    touches = [
        {"sensing": "point-plane", "part": part, "x_m": [0, 0, 0], "mu_m": [0.5 + x, y, 0.3 + z], "c_m2": variance}
        for part, z in (("lower", 0.0), ("upper", gap_m))
        for x, y in places
    ]
    parts = [
        {"name": "lower", "feature": "plane", "point_m": [0, 0, 0], "direction": [0, 0, 1]},
        {
            "name": "upper",
            "feature": "plane",
            "point_m": [0, 0, 0],
            "direction": [0, 0, 1],
            "slopes": {"gap": [0, 0, 1]},
        },
    ]
    shape = {"kind": "features", "parameters": [{"name": "gap", "start_m": 0.1}], "parts": parts}
    answer = fused({"measurements": touches, "prior": PRIOR, "shape": shape})
    assert answer["shape"]["values"] == pytest.approx([gap_m], abs=1e-5)
    # With 6 touches on each plate and a common tilt, the sigma of the gap is sigma sqrt(1/6 + 1/6).
    assert answer["shape"]["sigma"][0] == pytest.approx(2e-4 * np.sqrt(1 / 3), rel=0.02)


def test_mismatches_are_listed_with_their_values() -> None:
    rng = np.random.default_rng(3)
    p = problem([CODES[k] for k in rng.integers(len(CODES), size=14)], rng, bad=2)
    answer = fused({"measurements": [body_of(m) for m in p.measurements]})
    assert {r["index"] for r in answer["rejected"]} == set(p.bad)
    assert all(r["value"] > 10.0 for r in answer["rejected"])


REFUSED: dict[str, dict[str, Any]] = {
    "nothing to fuse": {},
    "shape without prior": {k: v for k, v in ROUND_POST.items() if k != "prior"},
    "part without shape": {k: v for k, v in ROUND_POST.items() if k != "shape"},
    "proof of a shape": {**ROUND_POST, "certify": True},
    "measurements and collect": {**NINE_KINDS, "collect": True},
    "unknown parameter": {**ROUND_POST, "shape": {
        "kind": "features", "parameters": [{"name": "gap", "start_m": 0.1}],
        "parts": [{"name": "wall", "feature": "plane", "point_m": [0, 0, 0], "slopes": {"gab": [0, 0, 1]}}]}},
    "prior without a rotation": {**NINE_KINDS, "prior": {**PRIOR, "quaternion_xyzw": [0.0, 0.0, 0.0, 0.0]}},
    "negative radius": {**ROUND_POST, "shape": {"kind": "cylinder", "radius_m": -0.1, "length_m": 0.1}},
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_a_body_that_makes_no_sense_is_refused(what: str) -> None:
    with pytest.raises(ValidationError):
        FuseRequest.model_validate_json(json.dumps(REFUSED[what]))


def test_an_unknown_part_is_refused_by_name() -> None:
    lid = {**ROUND_POST["measurements"][0], "part": "lid"}
    with pytest.raises(InvalidRequest, match="no part 'lid'"):
        fused({**ROUND_POST, "measurements": [lid]})


def edge_and_touches(rng: np.random.Generator, *, per_m2: float) -> dict[str, Any]:
    """Return nine touches of 0.2 mm on three faces of a corner; variances are in units of 1 / `per_m2` m^2."""
    faces = [(axis, place) for axis in range(3) for place in (0.1, 0.3, 0.5)]
    touches = []
    for axis, place in faces:
        point = np.full(3, place)
        point[axis] = 0.0
        point[(axis + 1) % 3] = 0.25
        sensed = point + 2e-4 * rng.standard_normal(3)
        touches.append(
            {
                "sensing": "point-plane",
                "x_m": [0.0, 0.0, 0.0],
                "u": np.eye(3)[axis].tolist(),
                "mu_m": sensed.tolist(),
                "c_m2": (4e-8 * per_m2 * np.eye(3)).tolist(),
            }
        )
    prior = {**PRIOR, "translation_m": [0.0, 0.0, 0.0], "covariance": (1e-4 * per_m2 * np.eye(6)).tolist()}
    return {"measurements": touches, "prior": prior}


def test_variances_in_square_millimetres_are_warned_of_and_those_in_square_metres_are_not() -> None:
    rng = np.random.default_rng(20261122)
    right = [fused(edge_and_touches(rng, per_m2=1.0))["warnings"] for _ in range(20)]
    wrong = [fused(edge_and_touches(rng, per_m2=1e6))["warnings"] for _ in range(20)]
    assert not any(right)
    assert all("mm^2" in warnings[0] for warnings in wrong)
