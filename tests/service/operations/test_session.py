"""The error of a failed motion names the failed device or what was in the arm's way."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from hal.errors import CellError, DeviceFault, MotionError, Stopped
from hal.motion import NO_LIMITS, Hold, MotionOutcome
from service.operations.session import Session


def failure(outcome: MotionOutcome, cause: str, **more: str) -> CellError:
    """Return the error that `run` raises for a motion with this outcome."""
    report = SimpleNamespace(name="to park", outcome=outcome, cause=cause, device=None, tripped=None)
    vars(report).update(more)
    mover: Any = SimpleNamespace(execute=lambda _: report)
    context: Any = SimpleNamespace(
        task=SimpleNamespace(check_cancelled=lambda: None), connection=SimpleNamespace(mover=mover), limits=NO_LIMITS
    )
    with pytest.raises(CellError) as raised:
        Session(context=context).run(Hold(name="to park", duration_s=1.0))
    return raised.value


def test_a_failure_of_a_device_names_it() -> None:
    error = failure(MotionOutcome.FAULT, "arm silent for 0.020 s", device="arm")
    assert isinstance(error, DeviceFault) and error.details["device"] == "arm"


def test_a_push_that_was_too_strong_is_no_failure_of_a_device() -> None:
    error = failure(MotionOutcome.FAULT, "contact force 104 N; at most 100 N is allowed", tripped="force_limit")
    assert isinstance(error, MotionError)
    assert "104 N" in error.what and "in the way" in error.hint


def test_a_stop_stays_a_stop() -> None:
    assert isinstance(failure(MotionOutcome.STOPPED, "the stop latch was set"), Stopped)
