from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial.transform import RigidTransform, Rotation

from hal.devices import DeviceKind, GripperState, JointState
from hal.errors import DeviceTimeout
from hal.readings import Cause, Quality, Stamped
from service.errors import NotConnected
from service.recording.codec import Unreadable, decode, decode_error, encode, encode_error


def again(value: Any) -> Any:
    """Return the value as it comes out of a file."""
    return decode(json.loads(json.dumps(encode(value), allow_nan=False)))


KINDS = st.sampled_from(["<f8", "<f4", "|u1", "<i8", "|b1"])


@given(KINDS.flatmap(lambda kind: arrays.arrays(kind, arrays.array_shapes(max_dims=3, max_side=9))))
def test_arrays_come_back_to_the_bit(array: Any) -> None:
    back = again(array)
    assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())


@given(st.floats())
def test_floats_come_back_to_the_bit(value: float) -> None:
    back = again(value)
    assert math.isnan(back) if math.isnan(value) else (back, math.copysign(1, back)) == (value, math.copysign(1, value))


def test_columns_of_a_matrix_stay_together() -> None:
    assert again(np.asfortranarray(np.ones((3, 4)))).flags.f_contiguous


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_poses_come_back_to_the_bit(six: list[float]) -> None:
    pose = RigidTransform.from_components(six[:3], Rotation.from_rotvec(six[3:]))
    assert np.array_equal(again(pose).as_matrix(), pose.as_matrix())
    assert np.array_equal(again(pose.rotation).as_quat(), pose.rotation.as_quat())


def test_a_reading_comes_back_with_everything_that_it_says() -> None:
    state = JointState(position_rad=np.arange(6.0), velocity_rad_per_s=np.zeros(6), is_moving=True)
    reading = Stamped(value=state, host_time_s=0.1 + 0.2, sequence=7, quality=Quality.DEGRADED, cause=Cause.COMM)
    back = again(reading)
    assert (back.host_time_s, back.sequence, back.device_time_s) == (0.1 + 0.2, 7, None)
    assert (back.quality, back.cause) == (Quality.DEGRADED, Cause.COMM)
    assert back.quality is Quality.DEGRADED
    assert back.value.position_rad.tolist() == list(range(6))
    assert back.value.is_moving


def test_containers_and_scalars_keep_their_types() -> None:
    value = (1, 2.0, True, None, "a", [1, (2,)], {"k": np.float64(0.5), 3: b"\x00\xff"}, DeviceKind.ARM)
    back = again(value)
    assert back == value
    assert [type(item) for item in back] == [type(item) for item in value]
    assert isinstance(back[6]["k"], np.float64)
    held = GripperState(width_m=0.04, force_n=1.0, is_moving=False, is_holding=True)
    assert again(held) == held


def test_errors_come_back_with_their_class_and_details() -> None:
    error = decode_error(encode_error(DeviceTimeout("silent", hint="cable", device="arm", waited_s=0.5)))
    assert isinstance(error, DeviceTimeout)
    assert (error.what, error.hint, error.details) == ("silent", "cable", {"device": "arm", "waited_s": 0.5})
    assert isinstance(decode_error(encode_error(NotConnected("x", hint="y"))), NotConnected)
    assert str(decode_error(encode_error(ZeroDivisionError("planted")))) == "ZeroDivisionError: planted"


@pytest.mark.parametrize(
    "written",
    [
        {"$class": "subprocess.Popen", "args": ["true"]},
        {"$class": "hal.devices.np.array", "object": [1]},
        {"$enum": ["os.system", "true"]},
        {"$class": "hal.devices.JointState", "unknown": 1},
        {"$opaque": "socket.socket"},
        {"$array": {"dtype": "|O", "shape": [1], "order": "C", "base64": "AAAAAAAAAAA="}},
        {"$array": {"dtype": "<f8", "shape": [3], "order": "C", "values": [1.0]}},
        {"$picture": {"topic": "/a", "sequence": 1}},
        {"two": 1, "keys": 2},
    ],
)
def test_only_values_of_the_device_interfaces_are_made(written: dict[str, Any]) -> None:
    with pytest.raises(Unreadable, match="cannot be read"):
        decode(written)


def test_what_has_no_form_is_named() -> None:
    assert encode(object()) == {"$opaque": "builtins.object"}
