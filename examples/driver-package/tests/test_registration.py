"""Once the package is installed, `driver = "serial:rangefinder"` is all that a cell file needs."""

from acme_rangefinder.rangefinder import connect
from acme_rangefinder.rangefinder_emulator import start

from hal.registry import device_factory, emulator_factory


def test_driver_and_emulator_are_found_by_name() -> None:
    assert device_factory("serial:rangefinder") is connect
    assert emulator_factory("rangefinder") is start
