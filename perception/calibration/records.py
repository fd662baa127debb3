"""Calibration results as records with version, date and quality figures, written as TOML that `hal` reads."""

from __future__ import annotations

from functools import partial

import numpy as np

from hal.calibration import CalibrationRecord, IntrinsicsRecord, LoadRecord, MountRecord, Vector3
from hal.geometry import UncertainPose
from hal.toml_text import toml_edited, toml_text
from perception.calibration.depth_bend import DepthBend
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
    result: InHandCalibration | CameraCalibration | ScannerCalibration | WrenchCalibration | DepthBend,
    *,
    date: str,
) -> CalibrationRecord:
    """Return the record of one result, with version 1.

    Args:
        device: its name in the cell file.
        date: ISO 8601, from the caller's clock.
    """
    record = partial(CalibrationRecord, device=device, date=date)
    if isinstance(result, DepthBend):
        quality = {"bend_before_per_m": result.before, "bend_after_per_m": result.after, "walls": float(result.walls)}
        return record(method="walls", depth_bend=result.record, quality=quality)
    if isinstance(result, WrenchCalibration):
        load = LoadRecord(
            mass_kg=result.load.mass_kg, centre_of_mass_m=result.load.centre_of_mass_m,
            bias_force_n=_three(result.load.bias[:3]), bias_torque_nm=_three(result.load.bias[3:]),
        )  # fmt: skip
        sigma_kg = float(np.sqrt(result.covariance[3, 3]))
        quality = {"rms_n": result.rms_n, "rms_nm": result.rms_nm, "mass_sigma_kg": sigma_kg}
        return record(method="tool-weight", load=load, quality=quality)
    quality = {"chi_square_ratio": result.chi_square / max(result.degrees, 1)}
    if isinstance(result, ScannerCalibration):
        mount = mount_of(result.flange_from_scanner)
        return record(method="plate-scans", mount=mount, quality=quality | {"rms_m": result.rms_m})
    if isinstance(result, CameraCalibration):
        sigmas = zip(result.names, np.sqrt(np.diag(result.covariance)).tolist(), strict=True)
        quality = {f"sigma_{name}": sigma for name, sigma in sigmas} | quality | {"cubic_bias_px": result.cubic.bias_px}
        return record(method="intrinsics", intrinsics=_lens_of(result), quality=quality)
    mount, i = mount_of(result.flange_from_camera), result.intrinsics
    sigma = dict(zip(FREE, result.lens_sigma.tolist(), strict=True))
    lens = _lens_of(
        result, sigma_k1=sigma["k1"], sigma_focal_ratio=max(sigma["fx"] / i.fx_px, sigma["fy"] / i.fy_px),
        sigma_centre_px=max(sigma["cx"], sigma["cy"]),
    )  # fmt: skip
    quality |= {"views": float(len(result.used)), "rms_px": result.rms_px}
    quality |= {"sigma_m": max(mount.sigma_m), "sigma_rad": max(mount.sigma_rad)}
    return record(method="hand-eye and lens by the panel's lights", mount=mount, intrinsics=lens, quality=quality)


def _lens_of(result: InHandCalibration | CameraCalibration, **sigmas: float) -> IntrinsicsRecord:
    """Return the record of a lens, with the standard deviations that are known."""
    i = result.intrinsics
    return IntrinsicsRecord(
        width_px=i.width_px, height_px=i.height_px, fx_px=i.fx_px, fy_px=i.fy_px, cx_px=i.cx_px, cy_px=i.cy_px,
        distortion=i.distortion, rms_px=result.rms_px, **sigmas,
    )  # fmt: skip


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


def _three(values: object) -> Vector3:
    """Return three values as a tuple of floats."""
    x, y, z = (float(v) for v in np.asarray(values, float))
    return (x, y, z)
