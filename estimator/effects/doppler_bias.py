"""One constant on the shift of every beam."""

from __future__ import annotations

import casadi as ca

from estimator.effects.declaration import Parameter, Sample, declare
from estimator.models.rotations import Matrix


def contribution(sample: Sample, p: Matrix) -> Matrix:
    """The bias on each beam (beams, Hz)."""
    return ca.repmat(p[0], sample.beam_direction.shape[0], 1)


EFFECT = declare(
    "doppler-bias", "doppler", (Parameter("bias", "Hz", 1.0, (-1000.0, 1000.0)),), contribution,
    summary="The same constant is added to the shift of every beam (an offset of the receiver's reference).",
    formula="bias",
    zero="bias = 0",
    reference="definition",
)
