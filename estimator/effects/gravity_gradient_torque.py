"""The Earth's gravity pulls harder on the near end of the body."""

from __future__ import annotations

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models import gravity_gradient
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """Torque (3, N m, tracker axes): the scale times the gravity-gradient torque."""
    return p[0] * gravity_gradient.torque(sample.position, sample.attitude, sample.inertia)


EFFECT = declare(
    "gravity-gradient-torque", "torque", (Parameter("scale", "1", 1.0, (0.0, 2.0), nominal=1.0),), contribution,
    summary="The torque of the Earth's gravity gradient on the rigid body; its size is known, a scale other than 1 "
            "refutes it.",
    formula="scale 3 mu/r^5 r x (J r), r in tracker axes",
    zero="scale = 0",
    reference="Wie, Space Vehicle Dynamics and Control, section 6.10",
)
