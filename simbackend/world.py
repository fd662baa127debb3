"""PyBullet world of one cell: arm, tool and panel, stepped tick by tick. Runs in a process of its own."""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.simulated import ObjectTruth, Truth
from simbackend import panel_events
from simbackend.arm_model import MODELS, arm_urdf, base_from_flange
from simbackend.contact_log import ContactLog, contacts_of
from simbackend.draws import Draws
from simbackend.drive import ArmDrive, GripperDrive
from simbackend.pads import Pads, Roots
from simbackend.panel_world import ARM_GROUP, PANEL_GROUP, PanelWorld
from simbackend.tool_model import AXES
from simbackend.wire import (
    GRIPPER_AT,
    JOINTS_AT,
    LIGHTS,
    LIGHTS_AT,
    MAX_PROXIMITY,
    MOST_JOINTS,
    PROXIMITY_TICKS,
    DriveCommand,
    WorldConfig,
)

GRAVITY_M_PER_S2 = 9.81
TIP_TICKS = 4  # how often to check which mechanisms are near; the tip moves up to 8 mm meanwhile
UNUSED_3 = (0.0,) * 3  # values of the snapshot that are always zero
FINGER_FORCE_N = 250.0  # of the motors, far above the gripper's: its own model limits the grip force
ARM_GAIN, FINGER_GAIN = 0.45, 0.6  # fraction of a joint's error that its motor corrects in one tick
CONE_RAYS = 4
CONE_RAD = 0.0175
CONE_DEPTH_M = 0.02
PAST_TICKS, PAST_KEPT = 100, 4500  # past object states for the judge: at 500 Hz every 0.2 s for 15 minutes of change


class World:
    """One simulated cell. Deterministic: equal configurations and commands give bit-identical results."""

    def __init__(self, config: WorldConfig) -> None:
        pybullet = _quiet_pybullet()
        self.config = config
        self.cell = config.cell
        self.dt_s = 1.0 / self.cell.file.cell.control_rate_hz
        self.draws = Draws(self.cell.file.cell.seed)
        self.tick = 0
        self._begun: dict[int, RigidTransform] = {}  # base_from_panel when an event began
        self.engine: Any = pybullet
        pybullet.connect(pybullet.DIRECT)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt_s, deterministicOverlappingPairs=1, enableFileCaching=0, numSolverIterations=50
        )
        pybullet.setGravity(0, 0, -GRAVITY_M_PER_S2)
        with tempfile.TemporaryDirectory(prefix="panelwright-world-") as folder:
            self._load_arm(Path(folder))
            self.panel = PanelWorld(pybullet, self.cell, self.draws, Path(folder))
        self.scene = self.panel.scene
        self._forces_on = ContactLog(self.panel.bodies, self.dt_s)
        self._ray_starts = np.repeat([mount.translation for mount in config.proximity], len(RAYS), axis=0).reshape(
            -1, 3
        )
        self._ray_directions = np.concatenate(
            [np.empty((0, 3)), *(mount.rotation.apply(RAYS) for mount in config.proximity)]
        )
        self._past: deque[tuple[int, tuple[ObjectTruth, ...]]] = deque(maxlen=PAST_KEPT)
        self.initial = self.panel.truth()
        self._proximity = np.full(MAX_PROXIMITY + 1, np.nan)  # distances, then the tick at which they were measured
        self._settle()
        self._measure_distances()

    def _load_arm(self, folder: Path) -> None:
        engine = self.engine
        self.model = MODELS[self.config.model]()
        mounts = {name: self._true_mount(name) for name in ("wrist_ft", "gripper")}
        load_kg = self._load_kg()
        urdf = arm_urdf(
            self.model, flange_from_sensor=mounts["wrist_ft"], flange_from_grip=mounts["gripper"], load_kg=load_kg
        )
        path = folder / "arm.urdf"
        path.write_text(urdf, encoding="ascii")
        # Without the flag the engine computes inertia from the shapes, and a light bat jumps through its stop.
        self.arm = engine.loadURDF(str(path), useFixedBase=True, flags=engine.URDF_USE_INERTIA_FROM_FILE)
        index = {engine.getJointInfo(self.arm, i)[1].decode(): i for i in range(engine.getNumJoints(self.arm))}
        self.joints = [index[f"link{i + 1}"] for i in range(len(self.model.capabilities.links))]
        fingers = [[index[f"give_{axis}_{side}"] for axis in AXES] for side in ("left", "right")]
        self.moving = [*self.joints, *fingers[0], *fingers[1]]  # in the engine's order
        self.sensor, self.flange_link = index["sensor"], index["flange"]
        self.flange_from_grip = mounts["gripper"]
        self.gripper_link = index["gripper"]
        for i in range(-1, engine.getNumJoints(self.arm)):
            engine.changeDynamics(self.arm, i, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0)
            engine.setCollisionFilterGroupMask(self.arm, i, ARM_GROUP, PANEL_GROUP)
        self.pads = Pads(
            engine, self.arm, [finger[-1] for finger in fingers], friction=self.cell.file.simulation.pad_friction
        )
        engine.enableJointForceTorqueSensor(self.arm, self.sensor, 1)
        park = np.asarray(self.cell.file.workspace.park_rad, float)
        self.drive = ArmDrive(self.model.capabilities, park, self.dt_s, lookahead_s=self.config.lookahead_s)
        is_rigid = self.cell.file.hand.fingers == 1  # the two fingers stay together as one
        self.gripper = GripperDrive(self.dt_s, width_m=0.0, _target_m=0.0) if is_rigid else GripperDrive(self.dt_s)
        slides = [finger[0] for finger in fingers]
        for joint, place in zip([*self.joints, *slides], [*park, *[self.gripper.width_m / 2] * 2], strict=True):
            engine.resetJointState(self.arm, joint, place)
        self.roots = Roots(engine, self.arm, fingers, dt_s=self.dt_s)
        held = [] if self.roots.yields else slides
        self.driven = [*self.joints, *held]
        self._forces = [*self.model.torque_nm, *[FINGER_FORCE_N] * len(held)]
        self._gains = [ARM_GAIN] * len(self.joints) + [FINGER_GAIN] * len(held)
        self._damps = [1.0] * len(self.driven)
        self._zeros = [0.0] * len(self.moving)

    def _true_mount(self, device: str) -> RigidTransform:
        section = self.cell.file.devices.get(device)
        kinds = {"wrist_ft": "force_torque", "gripper": "gripper"}
        if section is None:
            names = [n for n, d in self.cell.file.devices.items() if d.kind == kinds[device]]
            device = names[0] if names else device
        section = self.cell.file.devices.get(device)
        if section is None or section.mount is None:
            return RigidTransform.from_translation([0.0, 0.0, 0.0 if kinds.get(device) == "force_torque" else 0.21])
        record = self.cell.calibration_of(device).mount
        return self.draws.mount(device, record) if record is not None else RigidTransform.identity()

    def _load_kg(self) -> float:
        for name, device in self.cell.file.devices.items():
            if device.kind == "force_torque" and device.mount is not None:
                record = self.cell.calibration_of(name).load
                if record is not None:
                    return self.draws.load(name, record.load()).mass_kg
        return 0.9

    def _settle(self) -> None:
        """Let the joints settle before time begins."""
        self._read_joints()
        for _ in range(20):
            self._advance()
        self.tick = 0
        self._forces_on.forget()
        # The first picture loads the compiled kernel, which is better done now than during a motion.
        self.scene.draw(self.flange(), width=8, height=8, focal=(8.0, 8.0), centre=(3.5, 3.5), near_m=0.05, channels=1)

    def step(self, request: Array) -> Array:
        """Execute one request and advance by its number of ticks; return the snapshot vector."""
        self._obey(request)
        ticks = int(request[1])
        for i in range(ticks):
            self._advance()
            # Only the last measurement of a batch is visible to the client.
            if self.tick % PROXIMITY_TICKS == 0 and ticks - i <= PROXIMITY_TICKS:
                self._measure_distances()
        return self.snapshot()

    def _obey(self, request: Array) -> None:
        orders = int(request[2])
        if orders & DriveCommand.STOP:
            self.drive.stop()
        if orders & DriveCommand.ENABLE:
            self.drive.enable(self.q[: len(self.joints)])
        if orders & DriveCommand.SETPOINT:
            self.drive.aim(request[JOINTS_AT : JOINTS_AT + len(self.joints)])
        if request[GRIPPER_AT]:
            self.gripper.aim(*(float(x) for x in request[GRIPPER_AT + 1 : GRIPPER_AT + 4]))
        if request[LIGHTS_AT]:
            self.panel.switch_lights([bool(x) for x in request[LIGHTS_AT + 1 : LIGHTS_AT + 1 + LIGHTS]])

    def _advance(self) -> None:
        engine = self.engine
        self.drive.tick()
        self.gripper.tick(self.pads.force_n)
        half_m, pad_speed_m_per_s = self.gripper.width_m / 2, self.gripper.speed / 2
        # Gravity torque is added to the position motor: the servo sags by 2 to 12 mrad without it and by 1e-16 with it.
        efforts = list(engine.calculateInverseDynamics(self.arm, self.q, self._zeros, self._zeros))
        joints, held = len(self.joints), len(self.driven) - len(self.joints)
        places = (half_m, 0.0, 0.0) * 2
        speeds = (pad_speed_m_per_s, 0.0, 0.0) * 2
        efforts[joints:] = [
            self.roots.force_n(q - place, v - speed)
            for q, place, v, speed in zip(self.q[joints:], places, self.v[joints:], speeds, strict=True)
        ]
        engine.setJointMotorControlArray(self.arm, self.moving, engine.TORQUE_CONTROL, forces=efforts)
        engine.setJointMotorControlArray(
            self.arm,
            self.driven,
            engine.POSITION_CONTROL,
            targetPositions=[*self.drive.setpoint.tolist(), *[half_m] * held],
            targetVelocities=[*self.drive.speed.tolist(), *[pad_speed_m_per_s] * held],
            forces=self._forces,
            positionGains=self._gains,
            velocityGains=self._damps,
        )
        if self.tick % TIP_TICKS == 0:
            self.panel.wake(self.tip_m)
        self.panel.drive()
        engine.stepSimulation()
        self.tick += 1
        self._read_joints()
        self._read_contacts()
        if self.tick % PAST_TICKS == 0:
            self._remember()
            self._forces_on.end_block(self.tick)

    def _remember(self) -> None:
        """Keep the states of the objects if one has changed, and of each one that has not the state that is kept already."""
        last = self._past[-1][1] if self._past else self.initial
        now = tuple(old if old == new else new for old, new in zip(last, self.panel.truth(), strict=True))
        if now != last:
            self._past.append((self.tick, now))

    def _read_joints(self) -> None:
        engine = self.engine
        states = engine.getJointStates(self.arm, [*self.moving, self.sensor])
        self.q = [state[0] for state in states[:-1]]
        self.v = [state[1] for state in states[:-1]]
        self.reaction = states[-1][2]
        if self.tick % TIP_TICKS == 0:
            self.tip_m = engine.getLinkState(self.arm, self.gripper_link)[4]

    def _read_contacts(self) -> None:
        contacts = contacts_of(self.engine.getContactPoints(), self.arm)
        self.pads.note(contacts)
        if contacts:
            self._forces_on.note(contacts)
        else:
            self._forces_on.nothing()

    def snapshot(self) -> Array:
        """Return the vector whose parts `Snapshot` names."""
        joints = len(self.joints)
        spare = [0.0] * (MOST_JOINTS - joints)
        reaction = [-x for x in self.reaction]  # the world on the tool, not the sensor
        return np.array(
            [
                *(self.tick, self.tick * self.dt_s, self.drive.is_enabled, *self.tip_m, *UNUSED_3, joints),
                *self.q[:joints],
                *spare,
                *self.v[:joints],
                *spare,
                *self.drive.setpoint.tolist(),
                *spare,
                *reaction,
                *self.pads.force_n,
                *(self.gripper.width_m, self.gripper.is_moving, self.gripper.is_holding, 0.0),
                *self.panel.lights_on,
                *[0.0] * (LIGHTS - len(self.panel.lights_on)),
                *self._proximity,
            ]
        )

    def flange(self) -> RigidTransform:
        """Return the true base_from_flange."""
        return base_from_flange(self.model.capabilities.links, np.asarray(self.q[: len(self.joints)]))

    def _measure_distances(self) -> None:
        """Measure the nearest surface in a narrow cone along each sensor's z, averaged over the rays that hit it."""
        self._proximity[4] = self.tick
        if not self.config.proximity:
            return
        engine = self.engine
        state = engine.getLinkState(self.arm, self.flange_link)
        turn = np.array(engine.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        reach = self.config.proximity_range_m
        starts = self._ray_starts @ turn.T + state[4]
        ends = starts + reach * (self._ray_directions @ turn.T)
        hits = engine.rayTestBatch(starts.tolist(), ends.tolist(), collisionFilterMask=PANEL_GROUP)
        depths = [hit[2] * reach if hit[0] >= 0 else math.inf for hit in hits]
        for i in range(len(self.config.proximity)):
            self._proximity[i] = _nearest(depths[i * len(RAYS) : (i + 1) * len(RAYS)])

    def happen(self, index: int, fraction: float) -> None:
        """Apply an event of the cell file, or a fraction of its motion."""
        begun = self._begun.setdefault(index, self.panel.base_from_panel)
        panel_events.apply(self.panel, self.cell.file.simulation.events[index], begun, fraction)

    def show(self, index: int, value: float) -> None:
        """Let the object with this number in the panel file show another value; a lamp is lit from 0.5 on."""
        self.panel.show(self.panel.panel.objects[index].name, value)

    def truth(self, initial_s: float = 0.0) -> Truth:
        """Return the true states that the judge compares with.

        Args:
            initial_s: simulated time of the `initial` states, within the history kept; 0 is the beginning.
        """
        return Truth(
            base_from_panel_matrix=np.asarray(self.panel.base_from_panel.as_matrix()),
            objects=self.panel.truth(),
            peak_force_n=self._forces_on.peak_n,
            sim_time_s=self.tick * self.dt_s,
            initial=self._showed(initial_s),
            contact=self._forces_on.since(initial_s),
        )

    def _showed(self, time_s: float) -> tuple[ObjectTruth, ...]:
        """Return the object states at that time, or shortly before."""
        before = (things for tick, things in reversed(self._past) if tick * self.dt_s <= time_s)
        return next(before, self.initial)

    def close(self) -> None:
        """Disconnect from the engine."""
        self.engine.disconnect()


def _quiet_pybullet() -> Any:
    """Import PyBullet, suppressing the build time that the import prints directly to the terminal."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        import pybullet
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    return pybullet


def _nearest(depths_m: list[float]) -> float:
    """Return the mean depth of the rays that hit the nearest surface; NaN when none hits anything."""
    first_m = min(depths_m)
    if math.isinf(first_m):
        return math.nan
    seen = [depth for depth in depths_m if depth < first_m + CONE_DEPTH_M]
    return sum(seen) / len(seen)


def _cone() -> Array:
    turns = 2.0 * np.pi * np.arange(CONE_RAYS) / CONE_RAYS
    around = np.column_stack(
        [np.sin(CONE_RAD) * np.cos(turns), np.sin(CONE_RAD) * np.sin(turns), np.full(CONE_RAYS, np.cos(CONE_RAD))]
    )
    return np.vstack([[0.0, 0.0, 1.0], around])


RAYS = _cone()
