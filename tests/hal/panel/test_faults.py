"""An invalid panel file is refused with all its faults at once, each with key, value and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.errors import ConfigError
from hal.panel import Gauge, Lever, Panel, load_panel
from hal.strict import parse_toml

PLATE = """
schema = 1
name = "tiny"
width_m = 0.4
height_m = 0.3
lights = [
  { name = "nw", position_m = [-0.18, 0.13, 0.0] }, { name = "ne", position_m = [0.18, 0.13, 0.0] },
  { name = "se", position_m = [0.18, -0.13, 0.0] }, { name = "sw", position_m = [-0.18, -0.13, 0.0] },
]
"""
SCALE = 'scale = { minimum = 0.0, maximum = 10.0, unit = "bar", %s }'
DEGREES = SCALE % "at_min_deg = -135.0, at_max_deg = 135.0"
GAUGE = 'kind = "gauge"\nname = "pressure"\nposition_m = [0.0, 0.0]\nradius_m = 0.03\n'


def panel(*objects: str) -> Panel:
    return parse_toml(PLATE + "".join(f"[[objects]]\n{each}\n" for each in objects), Panel, source="tiny.toml")


def faults(*objects: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        panel(*objects)
    return list(refused.value.details["faults"])


def test_a_scale_in_degrees_under_a_key_for_radians_is_refused_and_says_so() -> None:
    """With such a scale a gauge at 1.08 bar would be read as 7.88 bar with a confidence of 0.999."""
    found = faults(GAUGE + SCALE % "at_min = -135.0, at_max = 135.0")
    assert len(found) == 2
    assert all("rad is beyond a full turn" in one for one in found)
    assert "objects.0.scale.at_min: -135 rad" in found[0] and "write at_min_deg = -135" in found[0]


def test_degrees_under_a_key_for_degrees_are_the_same_as_radians() -> None:
    made = panel(GAUGE + DEGREES).object("pressure")
    assert isinstance(made, Gauge)
    assert (made.scale.at_min, made.scale.at_max) == pytest.approx((-2.35619, 2.35619), abs=1e-5)


def test_named_places_may_be_given_in_degrees() -> None:
    states = 'states = [{ name = "closed", angle_deg = 90.0 }, { name = "open" }]'
    made = panel(f'kind = "lever"\nname = "valve"\nposition_m = [0.0, 0.0]\n{states}').object("valve")
    assert isinstance(made, Lever)
    assert made.states[0].angle_rad == pytest.approx(1.5708, abs=1e-4)


def test_an_angle_is_given_once() -> None:
    (found,) = faults(GAUGE + SCALE % "at_min = -2.0, at_min_deg = -135.0, at_max = 2.0")
    assert "given as at_min and as at_min_deg" in found


def test_the_places_of_a_slider_are_no_angles() -> None:
    slider = 'kind = "slider"\nname = "fader"\nposition_m = [0.0, 0.0]\ntravel_m = 0.05\n'
    assert any("unknown key 'at_min_deg'" in one for one in faults(slider + DEGREES))
    assert "beyond the track" in faults(slider + SCALE % "at_min = -1.0, at_max = 0.025")[0]


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('kind = "toggle"\ntilt_rad = 23.0', "tilt_deg = 23"),
        ('kind = "handwheel"\nmaximum_rad = 360.0', "maximum_deg = 360"),
        (
            'kind = "rotary"\nradius_m = 0.01\nstates = [{ name = "a", angle_rad = 45.0 }, { name = "b" }]',
            "angle_deg = 45",
        ),
        ('kind = "gauge"\nradius_m = 36.0\n' + DEGREES, "larger than the plate"),
        ('kind = "gauge"\nradius_m = 0.03\n' + DEGREES.replace("10.0", "-1.0"), "swap them"),
        ('kind = "guage"\nradius_m = 0.03\n' + DEGREES, "did you mean 'gauge'?"),
        ('kind = "gauge"\nradus_m = 0.03\n' + DEGREES, "did you mean 'radius_m'?"),
        ('kind = "lamp"\nradius_m = 0.01\nposition_m = [0.195, 0.0]', "5 mm beyond the plate"),
        ('kind = "lamp"\nradius_m = 0.01\nposition_m = [0.17, 0.13]', "overlaps"),
        ('kind = "button"\nradius_m = 0.01\nlights_lamp = "one"', "which is not a lamp"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_remedy(keys: str, says: str) -> None:
    place = "" if "position_m" in keys else "position_m = [0.0, 0.0]\n"
    assert any(says in one for one in faults(f'name = "one"\n{place}{keys}')), says


def test_all_faults_are_told_at_once() -> None:
    """This includes faults of positions, which otherwise could be found only if everything else is right."""
    found = faults(
        GAUGE + SCALE % "at_min = -135.0, at_max = 135.0",
        'kind = "lamp"\nname = "run"\nposition_m = [0.1, 0.0]\nradius_m = 0.01',
        'kind = "lamp"\nname = "run"\nposition_m = [0.105, 0.0]\nradius_m = 0.01',
        'kind = "lamp"\nname = "off"\nposition_m = [0.5, 0.0]\nradius_m = 0.01',
        'kind = "lampe"\nname = "what"\nposition_m = [0.0, 0.1]',
    )
    for says in (
        "at_min_deg",
        "at_max_deg",
        "given twice",
        "run overlaps run by 15 mm",
        "lies off the plate",
        "did you mean 'lamp'?",
    ):
        assert sum(says in one for one in found) == 1, (says, found)


def test_parts_whose_angles_or_keys_are_wrong_still_have_their_place() -> None:
    found = faults(
        GAUGE + SCALE % "at_min = -135.0, at_max = 135.0",
        'kind = "lamp"\nname = "run"\nposition_m = [0.02, 0.0]\nradius_m = 0.01\ncolor = "red"',
        'kind = "lamp"\nname = "off"\nposition_m = [0.02, 0.01]\nradius_m = "10 mm"',
    )
    assert sum("overlaps pressure" in one for one in found) == 1, found
    assert not any("off" in one and "overlaps" in one for one in found), "its size is not known"


def test_the_shipped_panels_can_be_meant() -> None:
    paths = sorted((Path(__file__).parents[3] / "panels").glob("*.toml"))
    assert paths
    for path in paths:
        assert load_panel(path).objects
