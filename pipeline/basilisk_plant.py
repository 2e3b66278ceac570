"""Chaser and target in orbit, flown by Basilisk.  The only module that imports Basilisk.

Basilisk integrates both spacecraft (RK4, point-mass Earth, rigid bodies); force and torque on the chaser are held
between two control steps.  Its Hill frame is radial, along-track, orbit normal, as ours.

Source: P. W. Kenneally, S. Piggott, H. Schaub, "Basilisk: a flexible, scalable and modular astrodynamics simulation
framework", 2020.
"""

from __future__ import annotations

import matplotlib
import numpy as np
from numpy.typing import NDArray

from pipeline.convert import NS_PER_S
from pipeline.dock_scenario import DockScenario
from pipeline.plant import Departure, Flight, hill_from_inertial

with matplotlib.rc_context():  # importing Basilisk changes how figures are laid out: that must not reach our reports
    from Basilisk.simulation import extForceTorque, spacecraft
    from Basilisk.utilities import RigidBodyKinematics, SimulationBaseClass, simIncludeGravBody

Array = NDArray[np.float64]

TASK = "dynamics"


class BasiliskPlant:
    """Two spacecraft in one Basilisk simulation."""

    def __init__(self, scenario: DockScenario, departure: Departure):
        self._step_ns = round(scenario.dynamics_step_s * NS_PER_S)
        self._simulation = SimulationBaseClass.SimBaseClass()
        process = self._simulation.CreateNewProcess("relnav")
        process.addTask(self._simulation.CreateNewTask(TASK, self._step_ns))
        self._earth = simIncludeGravBody.gravBodyFactory()
        self._earth.createEarth().isCentralBody = True

        self._target = self._add_spacecraft("target", scenario.target.mass_kg, scenario.target.inertia_kg_m2)
        self._chaser = self._add_spacecraft("chaser", scenario.chaser.mass_kg, scenario.chaser.inertia_kg_m2)
        self._actuators = extForceTorque.ExtForceTorque()
        self._chaser.addDynamicEffector(self._actuators)
        self._simulation.AddModelToTask(TASK, self._actuators)
        self._depart(scenario, departure)
        self._simulation.InitializeSimulation()

    def _add_spacecraft(
        self, name: str, mass_kg: float, inertia_kg_m2: tuple[float, float, float]
    ) -> spacecraft.Spacecraft:
        body = spacecraft.Spacecraft()
        body.ModelTag = name
        body.hub.mHub = mass_kg
        body.hub.IHubPntBc_B = np.diag(inertia_kg_m2).tolist()
        self._earth.addBodiesTo(body)
        self._simulation.AddModelToTask(TASK, body)
        return body

    def _depart(self, scenario: DockScenario, departure: Departure) -> None:
        """Put both in their orbits: the target on a circle, turning with its Hill frame."""
        radius_m, rate = scenario.orbit.radius_m, scenario.orbit.rate_rad_s
        speed_m_s, tilt = radius_m * rate, scenario.orbit.inclination_rad
        r_target = np.array([radius_m, 0.0, 0.0])
        v_target = speed_m_s * np.array([0.0, np.cos(tilt), np.sin(tilt)])
        R_inertial_hill = hill_from_inertial(r_target, v_target).T
        omega_hill = rate * R_inertial_hill[:, 2]
        r = R_inertial_hill @ departure.r_hill_m
        v = R_inertial_hill @ departure.v_hill_m_s + np.cross(omega_hill, r)
        for body, position, velocity, R_hill_body, omega_body in (
            (self._target, r_target, v_target, departure.R_hill_target, departure.omega_hill_target_rad_s),
            (self._chaser, r_target + r, v_target + v, departure.R_hill_chaser, np.zeros(3)),
        ):
            R_body_inertial = (R_inertial_hill @ R_hill_body).T
            body.hub.r_CN_NInit = position.reshape(3, 1).tolist()
            body.hub.v_CN_NInit = velocity.reshape(3, 1).tolist()
            body.hub.sigma_BNInit = RigidBodyKinematics.C2MRP(R_body_inertial).reshape(3, 1).tolist()
            body.hub.omega_BN_BInit = (R_body_inertial @ omega_hill + omega_body).reshape(3, 1).tolist()

    def advance(self, t_ns: int, force_chaser_n: Array, torque_chaser_n_m: Array) -> None:
        """Fly to ``t_ns`` after the start, a multiple of the dynamics step, under a force and a torque, chaser axes."""
        self._actuators.extForce_B = force_chaser_n.reshape(3, 1).tolist()
        self._actuators.extTorquePntB_B = torque_chaser_n_m.reshape(3, 1).tolist()
        self._simulation.ConfigureStopTime(t_ns)
        self._simulation.ExecuteSimulation()

    def flight(self) -> Flight:
        """Return where both are now."""
        chaser, target = self._chaser.scStateOutMsg.read(), self._target.scStateOutMsg.read()
        return Flight.from_inertial(
            r_target=np.array(target.r_BN_N),
            v_target=np.array(target.v_BN_N),
            R_inertial_target=RigidBodyKinematics.MRP2C(target.sigma_BN).T,
            omega_target=np.array(target.omega_BN_B),
            r_chaser=np.array(chaser.r_BN_N),
            v_chaser=np.array(chaser.v_BN_N),
            R_inertial_chaser=RigidBodyKinematics.MRP2C(chaser.sigma_BN).T,
            omega_chaser=np.array(chaser.omega_BN_B),
        )
