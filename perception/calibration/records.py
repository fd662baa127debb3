"""Calibration results as records with version, date and quality figures, written as TOML that `hal` reads."""

from __future__ import annotations

import numpy as np

from hal.calibration import CalibrationRecord, IntrinsicsRecord, LoadRecord, MountRecord, Vector3
from hal.geometry import UncertainPose
from hal.toml_text import toml_edited, toml_text
from perception.calibration.depth_bend import DepthBend
from perception.calibration.hand_eye import HandEye
from perception.calibration.in_hand import InHandCalibration
from perception.calibration.in_hand_model import FREE
from perception.calibration.intrinsics import CameraCalibration
from perception.calibration.scanner import ScannerCalibration
from perception.calibration.wrench import WrenchCalibration


def mount_of(parent_from_device: UncertainPose) -> MountRecord:
    """Return a mount: position, roll pitch yaw about fixed axes, and standard deviations with correlations."""
    pose, covariance = parent_from_device.parent_from_child, parent_from_device.covariance
    sigma = np.sqrt(np.diag(covariance))
    correlations = (covariance / np.outer(sigma, sigma))[np.tril_indices(6, -1)] if np.all(sigma > 0) else np.empty(0)
    return MountRecord(
        position_m=_three(pose.translation), rpy_rad=_three(pose.rotation.as_euler("xyz")), sigma_m=_three(sigma[:3]),
        sigma_rad=_three(sigma[3:]), correlations=tuple(np.round(correlations, 6).tolist()),
    )  # fmt: skip


def record_of(
    device: str,
    result: HandEye | InHandCalibration | CameraCalibration | ScannerCalibration | WrenchCalibration | DepthBend,
    *,
    date: str,
) -> CalibrationRecord:
    """Return the record of one result, with version 1.

    Args:
        device: its name in the cell file.
        date: ISO 8601, from the caller's clock.
    """
    if isinstance(result, HandEye):
        quality = {"chi_square_ratio": result.chi_square / max(result.degrees, 1), "views": float(len(result.used))}
        return CalibrationRecord(
            device=device, date=date, method="hand-eye", mount=mount_of(result.flange_from_camera), quality=quality
        )
    if isinstance(result, InHandCalibration):
        return _in_hand_record(device, result, date)
    if isinstance(result, ScannerCalibration):
        quality = {"chi_square_ratio": result.chi_square / max(result.degrees, 1), "rms_m": result.rms_m}
        return CalibrationRecord(
            device=device, date=date, method="plate-scans", mount=mount_of(result.flange_from_scanner), quality=quality
        )
    if isinstance(result, DepthBend):
        quality = {"bend_before_per_m": result.before, "bend_after_per_m": result.after, "walls": float(result.walls)}
        return CalibrationRecord(device=device, date=date, method="walls", depth_bend=result.record, quality=quality)
    if isinstance(result, WrenchCalibration):
        load = result.load
        sigma = np.sqrt(np.diag(result.covariance))
        return CalibrationRecord(
            device=device, date=date, method="tool-weight",
            load=LoadRecord(mass_kg=load.mass_kg, centre_of_mass_m=load.centre_of_mass_m,
                            bias_force_n=_three(load.bias[:3]), bias_torque_nm=_three(load.bias[3:])),
            quality={"rms_n": result.rms_n, "rms_nm": result.rms_nm, "mass_sigma_kg": float(sigma[3])},
        )  # fmt: skip
    return _camera_record(device, result, date)


def renewed(current: CalibrationRecord, found: CalibrationRecord) -> CalibrationRecord:
    """Return the present record updated with the new results, with its version incremented."""
    parts = {name: getattr(found, name) for name in ("mount", "intrinsics", "load", "depth_bend")}
    update = {name: part for name, part in parts.items() if part is not None}
    update["to_measure"] = tuple(part for part in current.to_measure if part not in update)
    about = {"date": found.date, "method": found.method, "quality": found.quality, "version": current.version + 1}
    return current.model_copy(update=update | about)


def to_toml(record: CalibrationRecord, *, over: str | None = None) -> str:
    """Return the record as the text of a TOML file: scalars first, then one table per part.

    Args:
        over: text of the file that is replaced; its comments are kept.
    """
    data = record.model_dump(mode="json", by_alias=True, exclude_none=True)
    if not record.to_measure:
        del data["to_measure"]
    return toml_text(data) if over is None else toml_edited(over, data)


def _in_hand_record(device: str, result: InHandCalibration, date: str) -> CalibrationRecord:
    """Return the record of a joint calibration of mount and lens."""
    i = result.intrinsics
    sigma = dict(zip(FREE, result.lens_sigma.tolist(), strict=True))
    mount = mount_of(result.flange_from_camera)
    return CalibrationRecord(
        device=device, date=date, method="hand-eye and lens by the panel's lights",
        mount=mount,
        intrinsics=IntrinsicsRecord(
            width_px=i.width_px, height_px=i.height_px, fx_px=i.fx_px, fy_px=i.fy_px, cx_px=i.cx_px, cy_px=i.cy_px,
            distortion=i.distortion, rms_px=result.rms_px, sigma_k1=sigma["k1"],
            sigma_focal_ratio=max(sigma["fx"] / i.fx_px, sigma["fy"] / i.fy_px),
            sigma_centre_px=max(sigma["cx"], sigma["cy"]),
        ),
        quality={"chi_square_ratio": result.chi_square / max(result.degrees, 1), "views": float(len(result.used)),
                 "rms_px": result.rms_px, "sigma_m": max(mount.sigma_m), "sigma_rad": max(mount.sigma_rad)},
    )  # fmt: skip


def _camera_record(device: str, result: CameraCalibration, date: str) -> CalibrationRecord:
    """Return the record of a calibration of the intrinsics."""
    i = result.intrinsics
    sigma = dict(zip(result.names, np.sqrt(np.diag(result.covariance)).tolist(), strict=True))
    quality = {f"sigma_{name}": value for name, value in sigma.items()}
    return CalibrationRecord(
        device=device, date=date, method="intrinsics",
        intrinsics=IntrinsicsRecord(
            width_px=i.width_px, height_px=i.height_px, fx_px=i.fx_px, fy_px=i.fy_px, cx_px=i.cx_px, cy_px=i.cy_px,
            distortion=i.distortion, rms_px=result.rms_px,
        ),
        quality=quality | {"chi_square_ratio": result.chi_square / max(result.degrees, 1),
                           "cubic_bias_px": result.cubic.bias_px},
    )  # fmt: skip


def _three(values: object) -> Vector3:
    """Return three values as a tuple of floats."""
    x, y, z = (float(v) for v in np.asarray(values, float))
    return (x, y, z)
