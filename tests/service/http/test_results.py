"""Every verb declares its answer in the API document, and the answers fit the declaration."""

from __future__ import annotations

import json
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
from fastapi.openapi.utils import get_openapi
from scipy.spatial.transform import RigidTransform

from hal.geometry import UncertainPose
from service.http import verbs
from service.http.models import TaskView, task_view
from service.jsonable import jsonable
from service.operations import OPERATIONS
from service.operations.sense import run_fuse
from service.schema.examples import NINE_KINDS, ROUND_POST
from service.schema.fuse_request import FuseRequest
from service.schema.mission_results import ActionClaim, ReadingClaim
from service.schema.results import PanelPoseResult, estimated

DOCUMENT = get_openapi(title="verbs", version="0", routes=verbs.router(OPERATIONS).routes)
SCHEMAS = DOCUMENT["components"]["schemas"]
RESULTS = {
    "panel-pose": "PanelPoseResult",
    "recognise": "RecogniseResult",
    "learn": "LearnResult",
    "inspect": "InspectResult",
    "fuse": "FuseResult",
    "manipulate": "ManipulateResult",
    "missions": "MissionResult",
    "calibrations": "CalibrationResult",
    "judge": "EvaluateResult",
}


def of(name: str) -> dict[str, Any]:
    """Return a schema of the document as a self-contained schema."""
    return {"$ref": f"#/components/schemas/{name}", "components": {"schemas": SCHEMAS}}


def test_each_verb_answers_with_a_task_whose_result_has_a_model_of_its_own() -> None:
    answered = {}
    for path, methods in DOCUMENT["paths"].items():
        for status in ("200", "202"):
            reference = methods["post"]["responses"][status]["content"]["application/json"]["schema"]["$ref"]
            task = SCHEMAS[reference.rpartition("/")[2]]
            (model,) = (part["$ref"] for part in task["properties"]["result"]["anyOf"] if "$ref" in part)
            answered[path.removeprefix("/v1/")] = model.rpartition("/")[2]
    assert answered == RESULTS
    assert set(RESULTS) == set(OPERATIONS)


@pytest.mark.parametrize("name", RESULTS.values())
def test_every_field_of_a_result_is_typed(name: str) -> None:
    untyped = [
        f"{model}.{key}"
        for model in (name, *_used_by(name))
        for key, field in SCHEMAS[model].get("properties", {}).items()
        if not {"type", "$ref", "anyOf", "allOf", "const", "enum"} & set(field)
    ]
    assert untyped == []


def _used_by(name: str, seen: frozenset[str] = frozenset()) -> set[str]:
    found = {part.partition('"')[0] for part in json.dumps(SCHEMAS[name]).split("#/components/schemas/")[1:]}
    new = found - seen
    return new.union(*(_used_by(model, seen | found) for model in new))


@pytest.mark.parametrize("body", [NINE_KINDS, ROUND_POST])
def test_a_fused_answer_fits_its_schema(body: dict[str, Any]) -> None:
    session: Any = None  # measurements in the request need no cell
    answer = run_fuse(session, FuseRequest.model_validate_json(json.dumps(body)))
    jsonschema_rs.validate(of("FuseResult"), json.loads(json.dumps(jsonable(answer))))


def test_a_pose_is_given_with_the_sigma_of_each_axis() -> None:
    pose = UncertainPose(
        parent_from_child=RigidTransform.from_translation([0.1, 0.2, 0.3]), covariance=np.diag([1, 4, 9, 16, 25, 36.0])
    )
    answer = PanelPoseResult(
        way="lights",
        base_from_panel=estimated(pose),
        checks=[],
        chi_square=1.5,
        degrees_of_freedom=2,
        ambiguous=False,
        alternatives=0,
        points_px={"a": [1.0, 2.0]},
    )
    plain = jsonable(answer)
    assert plain["base_from_panel"]["sigma_m"] == [1.0, 2.0, 3.0]
    assert plain["base_from_panel"]["sigma_rad"] == [4.0, 5.0, 6.0]
    assert plain["plate_in_scanner"] is None
    jsonschema_rs.validate(of("PanelPoseResult"), plain)


def test_claims_keep_their_own_fields() -> None:
    reading = ReadingClaim(name="a", what="read", claimed="on", truth="on", right=True)
    action = ActionClaim(name="a", what="toggle", claimed="done", truth="off to on", right=True, reached=True)
    assert "reached" not in jsonable(reading) and jsonable(action)["reached"] is True


def test_the_document_names_a_task_after_its_result() -> None:
    view = task_view(PanelPoseResult)
    assert view.__name__ == "PanelPoseTask" and issubclass(view, TaskView)
