"""On the simulated cell, what a cable hides from straight ahead is read from the side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.behind_cables import drawn_cable, open_session, with_cables
from hal.config import CableSection, load_cell
from hal.errors import StaleReading, Unreachable
from hal.simulated import Fault
from manipulation.skills.context import panel_from_grip
from perception.vision import viewpoints
from perception.vision.reading import ANSWER_AT, ObjectReading, answer_at
from service.operations import acquisition, inspect, locate, manipulate, range_detection
from service.operations.inspect import Inspection, close_ups, inspect_close
from service.operations.session import Session
from service.operations.travel import skill_context
from service.schema.requests import InspectRequest

ROOT = Path(__file__).parents[3]
pytestmark = pytest.mark.timeout(300)
CABLE = CableSection(path_m=((0.06, 0.3, 0.05), (0.098, 0.118, 0.03), (0.16, 0.0, 0.05)), radius_m=0.005)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """Yield a session with the panel of seed 9 located and a cable in front of its display."""
    cell = with_cables(load_cell(ROOT / "cells/bench.toml", seed=9), CABLE)
    with open_session(cell, tmp_path_factory.mktemp("look-past")) as session:
        yield session


def truth_of(session: Session, name: str) -> Any:
    """Return the true text, state or value of the object."""
    arm = session.connection.device("arm")
    return next(panel_object for panel_object in arm.truth().objects if panel_object.name == name)


def straight_look(session: Session) -> Inspection:
    """Look from straight ahead without memory of the display, because the last number would decide between two."""
    session.world.forget_reading("temperature")
    return inspect.look_close(session, session.panel.object("temperature").point_m, ("temperature",))


def test_a_display_behind_a_cable_is_read_from_the_side(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    session.world.forget_reading("temperature")
    with monkeypatch.context() as patch:
        patch.setattr(viewpoints, "SIDES", {})
        straight = inspect_close(session, ("temperature", "flow"))
    assert not straight.readings["temperature"].answered and straight.readings["flow"].answered
    found = inspect_close(session, ("temperature", "flow"))
    reading = found.readings["temperature"]
    assert reading.text == truth_of(session, "temperature").text
    assert len(found.pictures) > len(straight.pictures), "every look leaves its picture"
    assert [picture.title for picture in found.pictures][-1].startswith("temperature from ")
    assert session.world.readings["temperature"] is reading


def test_a_toggle_that_an_earlier_look_showed_in_its_other_state_is_looked_at_from_the_side(session: Session) -> None:
    straight = close_ups(session, ("pump",)).readings["pump"]
    other = {"on": "off", "off": "on"}[str(straight.state)]
    session.world.note_readings([replace(straight, state=other)])
    found = inspect_close(session, ("pump",))
    assert found.readings["pump"].state == truth_of(session, "pump").state
    assert found.pictures[-1].title == "pump from the right"
    assert len(inspect_close(session, ("pump",)).pictures) == 1, "the looks agree now"


def test_what_is_read_behind_a_cable_is_looked_at_from_a_side_and_both_looks_must_agree(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    locate.ensure_space_is_known(session)
    first = close_ups(session, ("temperature", "flow", "pump"))
    assert range_detection.half_hidden(session, ("temperature", "flow", "pump"), first.scans) == ["temperature"]
    monkeypatch.setattr(inspect, "half_hidden", lambda *_: ["pump"])
    shown = replace(first, readings={"pump": first.readings["pump"]})
    agreed = inspect.look_past(session, shown)
    assert agreed.readings["pump"].state == truth_of(session, "pump").state
    assert [picture.title for picture in agreed.pictures[len(first.pictures) :]] == ["pump from the right"]
    other = {"on": "off", "off": "on"}[str(agreed.readings["pump"].state)]
    deceived = replace(shown, readings={"pump": replace(shown.readings["pump"], state=other)})
    found = inspect.look_past(session, deceived).readings["pump"]
    assert not found.answered and "contradict each other" in str(found.reason)
    assert "pump" not in session.world.readings or not session.world.readings["pump"].answered


def test_a_side_that_the_arm_cannot_reach_is_left_out(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise Unreachable("no way there", hint="none")

    first = straight_look(session)
    monkeypatch.setattr(inspect, "go_to_camera_view", refuse)
    found = inspect.look_past(session, first)
    assert found.readings["temperature"].reason == first.readings["temperature"].reason
    assert found.pictures == first.pictures
    assert "temperature" not in session.world.readings


def test_a_cap_that_looks_alike_from_afar_is_read_by_its_height(session: Session) -> None:
    straight = close_ups(session, ("hold",))
    assert not straight.readings["hold"].answered, "a black cap in a black ring"
    found = inspect.look_past(session, straight)
    assert found.readings["hold"].state == truth_of(session, "hold").state == "released"
    assert len(found.pictures) == len(straight.pictures), "no look from a side is needed"


def test_a_range_image_that_was_taken_before_proves_a_height_without_another_way(session: Session) -> None:
    unread = close_ups(session, ("hold",)).readings["hold"]
    range_detection._face(session, session.panel.object("hold").point_m, name="face the cap")
    near = range_detection.scan_beside(session)
    inspect.go_to_overview(session)
    stood = session.mover.state().position_rad
    told = range_detection.read_by_height(session, [unread], near)
    assert told["hold"].state == truth_of(session, "hold").state
    assert np.array_equal(session.mover.state().position_rad, stood)


def test_a_look_goes_on_without_a_range_image_from_its_place(session: Session) -> None:
    scanner = session.connection.device("range_scanner")
    scanner.inject_fault(Fault.SILENT)
    try:
        assert range_detection.scan_beside(session) == ()
    finally:
        scanner.inject_fault(None)


def test_a_scanner_that_fails_leaves_the_cap_to_looks_from_close_by(session: Session) -> None:
    scanner = session.connection.device("range_scanner")
    straight = close_ups(session, ("hold",))
    scanner.inject_fault(Fault.SILENT)
    try:
        found = inspect.look_past(session, straight)
    finally:
        scanner.inject_fault(None)
    looks = [picture.title for picture in found.pictures[len(straight.pictures) :]]
    assert len(looks) == 1 and "close by" in looks[0], "the first look from close by shows it"
    assert found.readings["hold"].state == truth_of(session, "hold").state == "released"


def test_neighbours_that_cannot_be_read_are_looked_at_together(session: Session) -> None:
    first = close_ups(session, ("hold", "start"))
    unread = {name: replace(told, state=None, reason="doubted") for name, told in first.readings.items()}
    found = inspect.look_past(session, replace(first, readings=unread))
    titles = [picture.title for picture in found.pictures[len(first.pictures) :]]
    assert found.readings["start"].state == truth_of(session, "start").state
    assert titles[0] in ("hold, start from the right", "start, hold from the right")
    assert len(titles) <= len(viewpoints.SIDES), "each side once"
    assert titles[-1].startswith("hold from "), "what has been told is not asked for again"


def test_a_guess_is_answered_to_who_asks_for_it_and_not_remembered(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = close_ups(session, ("start",))
    doubtful = answer_at(replace(straight.readings["start"], confidence=ANSWER_AT - 0.1), ANSWER_AT)
    session.world.forget_reading("start")
    monkeypatch.setattr(inspect, "inspect_close", lambda *_: replace(straight, readings={"start": doubtful}))
    (refusal,) = inspect.run_inspect(session, InspectRequest(objects=("start",))).objects
    (guess,) = inspect.run_inspect(session, InspectRequest(objects=("start",), least_confidence=0.0)).objects
    assert refusal.state is None and refusal.reason
    assert guess.state == "released" and guess.reason is None and guess.confidence < ANSWER_AT
    assert "start" not in session.world.readings, "missions go by what is sure"


def test_a_camera_that_froze_on_the_way_is_named_by_the_first_close_up(session: Session) -> None:
    """The first frozen frame is not a repetition yet; it shows the old view, so the panel's pose could be blamed."""
    camera = session.connection.device("wrist_camera")
    inspect.go_to_overview(session)
    camera.inject_fault(Fault.FROZEN)
    try:
        with pytest.raises(StaleReading, match="wrist_camera repeats the same frame"):
            inspect.look_close(session, session.panel.object("flow").point_m, ("flow",))
    finally:
        camera.inject_fault(None)


def test_many_unread_objects_are_no_cables_work(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    first = straight_look(session)
    unread: ObjectReading = first.readings["temperature"]
    monkeypatch.setattr(inspect, "MOST_UNREAD", 0)
    assert inspect.look_past(session, first) is first and not unread.answered


def test_the_benchmarks_cables_hang_clear_of_the_plate_from_border_to_border() -> None:
    for seed in range(20):
        cable = drawn_cable(np.random.default_rng(seed), (0.3, 0.22))
        ends = np.array(cable.path_m)[[0, -1]]
        assert (np.abs(ends[:, :2]) > (0.3, 0.22)).any(axis=1).all()
        assert min(z for _, _, z in cable.path_m) >= 0.028


def test_no_transfer_leads_through_a_cable(session: Session) -> None:
    locate.ensure_space_is_known(session)
    context = skill_context(session)
    grip = context.panel_pose * panel_from_grip(CABLE.path_m[1], 0.0) * context.flange_from_grip.inv()
    model = context.collision(width_m=0.0, near_plate=True, may_touch=[one.name for one in session.panel.objects])
    touching = context.kinematics.inverse(grip)
    assert len(touching) > 0 and not any(model.is_clear(q, margin_m=0.0) for q in touching)
    assert all("what stands before the panel" in model.nearest(q) for q in touching)


def test_a_plate_that_is_not_where_it_was_located_is_no_obstacle(session: Session) -> None:
    pose = session.known_panel()
    nearer = pose.parent_from_child * RigidTransform.from_translation([0.0, 0.0, -0.018])
    session.world.believe_panel(replace(pose, parent_from_child=nearer))
    session.world.note_obstacles(None)
    try:
        locate.ensure_space_is_known(session)
    finally:
        session.world.believe_panel(pose)
    assert session.world.obstacles == ()


def test_a_second_look_without_a_stroke_between_is_taken_from_beside(session: Session) -> None:
    eye = manipulate._Eye(session, session.panel.object("setpoint"), True)
    verify = eye.verify()
    assert verify is not None
    truth, places = truth_of(session, "setpoint").value, []
    for _ in range(2):
        seen = verify()
        assert seen is not None and seen.value == pytest.approx(truth, abs=2.0)
        places.append(acquisition.camera_over_panel(session))
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(manipulate.BESIDE_M, abs=0.002)
    straight_look(session)  # of another object: the arm has moved, as it does in a stroke
    assert verify() is not None
    np.testing.assert_allclose(acquisition.camera_over_panel(session), places[0], atol=0.002)
