"""A whole panel is taught from one image by clicked outlines, lights and answers, and is then read."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hal.errors import Ambiguous, ConfigError, InvalidRequest, NotFound
from hal.panel import Panel
from hal.strict import parse_toml
from perception.vision.finding.framing import check_upright, one_plate
from perception.vision.image import as_gray
from perception.vision.inspection import inspect_view
from perception.vision.knowledge import NOTHING
from perception.vision.knowledge_files import load_knowledge
from perception.vision.projection import CameraProjection
from perception.vision.teaching.lesson import Overview, example_at, likest, overview_of, teach, teach_example
from perception.vision.teaching.panel_lights import find_border_lights
from perception.vision.teaching.panel_questions import kind_question, questions
from perception.vision.teaching.panel_teach import PanelObjectDraft, panel_text
from tests.perception.vision.bench_panel import SHOWN, panel, scene

PLATE = (0.60, 0.40)
ANSWERS: dict[str, dict[str, str]] = {
    "pressure": {},
    "volts": {"maximum": "5", "unit": "V"},
    "flow": {"decimals": "1"},
    "ready": {},
    "mode": {"states": "off=-45.8, low=0, high=45.8"},
    "speed": {"maximum": "100", "unit": "%"},
    "inlet": {"states": "closed=0, open=90"},
    "emergency": {},
}


@pytest.fixture(scope="module")
def seen() -> tuple[np.ndarray, CameraProjection, Overview]:
    image, intrinsics, pose = scene(tilt_deg=2.0, distance_m=0.66, pose_error=0.0)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    return image, view, overview_of(image, plate_m=PLATE)


def corners_of(view: CameraProjection, name: str) -> list[tuple[float, float]]:
    """Return two opposite corners around an object, as a person clicks them."""
    panel_object = panel().object(name)
    w, h = panel_object.face.half_width_m, panel_object.face.half_height_m
    x, y = panel_object.position_m
    return [(float(u), float(v)) for u, v in view.project([[x - w, y + h, 0.0], [x + w, y - h, 0.0]])]


def middle_of(view: CameraProjection, name: str) -> list[tuple[float, float]]:
    u, v = view.project([panel().object(name).point_m])[0]
    return [(float(u), float(v))]


def drafts(seen: tuple[np.ndarray, CameraProjection, Overview]) -> list[PanelObjectDraft]:
    _, view, overview = seen
    made = []
    for name, answers in ANSWERS.items():
        kind = panel().object(name).kind
        clicks = middle_of(view, name) if kind == "lever" else corners_of(view, name)
        made.append(PanelObjectDraft(kind=kind, name=name, example=example_at(overview, clicks), answers=answers))
    return made


@pytest.mark.parametrize(("name", "shape"), [("pressure", "circle"), ("volts", "rectangle"), ("mode", "circle")])
def test_one_click_finds_the_outline(
    seen: tuple[np.ndarray, CameraProjection, Overview], name: str, shape: str
) -> None:
    _, view, overview = seen
    found = example_at(overview, middle_of(view, name))
    face = panel().object(name).face
    w, h = face.half_width_m, face.half_height_m
    assert found.outline is not None and found.outline.shape == shape
    assert np.allclose(found.size_m, (2 * w, 2 * h), atol=0.009)  # the outline of the bezel or of the face
    assert np.allclose(overview.in_image([found.centre_m])[0], middle_of(view, name)[0], atol=8.0)


def test_a_click_on_bare_plate_finds_nothing(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    _, view, overview = seen
    bare = [(float(u), float(v)) for u, v in view.project([[0.12, -0.15, 0.0], [0.14, -0.17, 0.0]])]
    for clicks in (bare[:1], bare):
        with pytest.raises(NotFound, match="nothing but plate"):
            example_at(overview, clicks)
    assert example_at(overview, bare, kind="nothing").outline is None


def test_what_is_clicked_on_is_named_and_after_a_lesson_named_rightly(
    seen: tuple[np.ndarray, CameraProjection, Overview],
) -> None:
    _, view, overview = seen
    knowledge = load_knowledge()
    knob = likest(overview, example_at(overview, middle_of(view, "mode")), knowledge)
    assert knob is not None and knob.kind == "rotary"
    stop = example_at(overview, middle_of(view, "emergency"))
    lesson = teach_example(stop, knowledge, kind="mushroom")
    after = likest(overview, stop, lesson.knowledge)
    assert lesson.is_new_kind and after is not None and after.kind == "mushroom" and after.reason is None


def test_a_taught_panel_is_a_panel_file_that_reads_the_same_image(
    seen: tuple[np.ndarray, CameraProjection, Overview],
) -> None:
    image, _, overview = seen
    text = panel_text("taught", overview, find_border_lights(overview), drafts(seen))
    made = parse_toml(text, Panel, source="taught")
    assert {panel_object.name for panel_object in made.objects} == set(ANSWERS)
    for panel_object in made.objects:
        assert np.allclose(panel_object.position_m, panel().object(panel_object.name).position_m, atol=0.004), (
            panel_object.name
        )
    readings = {r.name: r for r in inspect_view(image, as_gray(image), overview.view, made)}
    assert readings["pressure"].value == pytest.approx(6.3, abs=0.2)
    assert readings["flow"].text == SHOWN["flow"]
    assert readings["mode"].state == SHOWN["mode"]


def test_ends_of_a_scale_may_be_pointed_at(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    _, view, overview = seen
    gauge = panel().object("pressure")
    angles = np.deg2rad([-135.0, 135.0])
    marks = np.array(gauge.position_m) + 0.03 * np.column_stack([np.sin(angles), np.cos(angles)])
    low, high = view.project(np.column_stack([marks, np.zeros(2)]))
    answers = {"at_min": f"{low[0]:.1f},{low[1]:.1f}", "at_max": f"{high[0]:.1f},{high[1]:.1f}"}
    example = example_at(overview, corners_of(view, "pressure"))
    draft = PanelObjectDraft(kind="gauge", name="pressure", example=example, answers=answers)
    text = panel_text("taught", overview, find_border_lights(overview), [draft])
    scale = parse_toml(text, Panel, source="taught").objects[0].scale
    assert (scale.at_min, scale.at_max) == pytest.approx(tuple(angles), abs=0.05)


def test_border_lights_are_seen_or_pointed_at(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    _, view, overview = seen
    true_m = np.array([light.position_m for light in panel().lights])
    clicks = [(float(u) + 3, float(v) - 2) for u, v in view.project(true_m[[2, 0, 3, 1]])]
    pointed = find_border_lights(overview, clicks)
    assert pointed.are_seen and np.allclose(pointed.places_m, true_m[:, :2], atol=0.004)
    with pytest.raises(InvalidRequest, match="2 lights"):
        find_border_lights(overview, clicks[:2])


def test_lights_that_nobody_saw_are_called_a_guess(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    image, view, _ = seen
    blank = image.copy()
    for u, v in view.project([light.position_m for light in panel().lights]):
        cv2.circle(blank, (round(u), round(v)), 26, 128, -1)
        cv2.circle(blank, (round(u), round(v)), 26, 128, 9)
    overview = overview_of(cv2.GaussianBlur(blank, (0, 0), 2.0), plate_m=PLATE, view=view)
    found = find_border_lights(overview)
    if not found.are_seen:
        assert "a guess" in panel_text("dark", overview, found, [])
    assert found.places_m.shape == (4, 2)


@pytest.mark.parametrize(
    ("kind", "answers", "error"),
    [
        ("gauge", {"minimum": "low"}, InvalidRequest),
        ("gauge", {"minimum": "nan"}, InvalidRequest),
        ("gauge", {"minimum": "10", "maximum": "0"}, ConfigError),
        ("gauge", {"colour": "red"}, InvalidRequest),
        ("display", {"style": "nixie"}, InvalidRequest),
        ("rotary", {"states": "on"}, InvalidRequest),
        ("pyramid", {}, InvalidRequest),
    ],
)
def test_answers_that_make_no_sense_are_refused(
    seen: tuple[np.ndarray, CameraProjection, Overview], kind: str, answers: dict[str, str], error: type[Exception]
) -> None:
    _, view, overview = seen
    draft = PanelObjectDraft(
        kind=kind, name="thing", example=example_at(overview, middle_of(view, "pressure")), answers=answers
    )
    with pytest.raises(error):
        panel_text("taught", overview, find_border_lights(overview), [draft])


def test_every_question_but_the_name_has_an_answer_that_stands() -> None:
    for kind in kind_question(load_knowledge()).choices:
        name, *rest = questions(kind)
        assert name.key == "name"
        assert all(question.default or question.key == "unit" for question in rest)
        assert all(question.default in question.choices for question in rest if question.choices)


def test_two_panels_are_ambiguous_and_one_is_not(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    image, _, _ = seen
    assert one_plate(image, PLATE)
    for both in (np.hstack([image, image]), np.vstack([image, image])):
        with pytest.raises(Ambiguous, match="two panels"):
            teach(np.ascontiguousarray(both), load_knowledge(), kind="lamp", clicks_px=[(10, 10)], plate_m=PLATE)


def test_a_panel_upside_down_is_refused(seen: tuple[np.ndarray, CameraProjection, Overview]) -> None:
    image, _, overview = seen
    check_upright(image, overview.view, panel())
    turned = np.ascontiguousarray(image[::-1, ::-1])
    with pytest.raises(NotFound, match="upside down"):
        check_upright(turned, overview_of(turned, plate_m=PLATE).view, panel())


@pytest.mark.parametrize(
    ("askew", "words"),
    [
        (np.fliplr, "is mirrored in"),
        (np.flipud, "mirrored and upside down"),
    ],
)
def test_a_panel_that_is_mirrored_is_refused(
    seen: tuple[np.ndarray, CameraProjection, Overview], askew: Callable[[np.ndarray], np.ndarray], words: str
) -> None:
    """Otherwise a mirrored gauge would be read wrongly with high confidence, and its look would be taught."""
    image = np.ascontiguousarray(askew(seen[0]))
    with pytest.raises(NotFound, match=words):
        check_upright(image, one_plate(image, PLATE).view, panel())


def test_a_second_example_takes_no_object_from_another_kind() -> None:
    """Every kind gets a second example from a new image; in further images all objects found before are still found."""
    knowledge = load_knowledge()
    lesson_image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.66, pose_error=0.0, azimuth_deg=120.0)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    tests = [
        scene(tilt_deg=t, azimuth_deg=a, distance_m=0.66, pose_error=0.0)[0] for t, a in ((3, 200), (8, 20), (12, 300))
    ]
    before = [_found(image, knowledge) for image in tests]
    taught = 0
    for panel_object in panel().objects:
        try:
            lesson = teach(
                lesson_image,
                knowledge,
                kind=panel_object.kind,
                clicks_px=corners_of(view, panel_object.name),
                plate_m=PLATE,
            )
        except Ambiguous:
            continue  # refused because it would make another kind worse, as promised
        taught += lesson.added
        knowledge = lesson.knowledge
    assert taught >= 2 and NOTHING in {kind.name for kind in knowledge.kinds}
    for was, image in zip(before, tests, strict=True):
        assert was <= _found(image, knowledge)


def _found(image: np.ndarray, knowledge: object) -> set[str]:
    """Return the names of the panel's objects that are found with the right kind."""
    overview = overview_of(image, plate_m=PLATE)
    from perception.vision.teaching.lesson import check

    hits = [c for c in check(image, knowledge, plate_m=PLATE, view=overview.view) if c.reason is None]
    return {
        panel_object.name
        for panel_object in panel().objects
        for c in hits
        if c.kind == panel_object.kind and np.linalg.norm(c.centre_m - panel_object.position_m) < 0.015
    }


@settings(max_examples=30, deadline=None)
@given(unit=st.text())
@example(unit='l/min\nof "air" \\ # no comment')
def test_any_unit_survives_the_panel_file(seen: tuple[np.ndarray, CameraProjection, Overview], unit: str) -> None:
    _, view, overview = seen
    gauge = example_at(overview, corners_of(view, "pressure"))
    draft = PanelObjectDraft(kind="gauge", name="pressure", example=gauge, answers={"unit": unit})
    text = panel_text("taught", overview, find_border_lights(overview), [draft])
    said = parse_toml(text, Panel, source="taught").objects[0].scale.unit
    assert said == unit.strip() or not unit.strip()
