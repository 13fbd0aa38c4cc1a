"""The navigation receiver's antenna is away from the centre of mass."""

from __future__ import annotations

from estimator.effects.declaration import Sample, axes, declare
from estimator.models.rotations import Matrix, about_z, conjugate, rotate


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Change of the measured position (3, m, Earth-fixed) by the arm ``p`` (3, m, tracker axes).

    It acts where the attitude is known, that is inside the arcs.
    """
    inertial = rotate(conjugate(sample.attitude), p)
    return sample.inside_arc * rotate(conjugate(about_z(sample.earth_angle)), inertial)


EFFECT = declare(
    "gnss-lever-arm", "gnss", axes("arm", "m", 1.0, 20.0), contribution,
    summary="The receiver's antenna is off the centre of mass by an arm fixed in the body; the measured position turns "
            "with the attitude.",
    formula="earth_fixed_from_inertial inertial_from_tracker arm, inside the arcs",
    zero="arm = 0",
    reference="Montenbruck and Gill, Satellite Orbits, section 6.2 (antenna offset)",
)
