"""Parts of the campaign simulator: scenario, orbit, pointing, rigid rotation, effects, sensors, truth.

The simulator shares no model with the estimator. The orbit is integrated in inertial axes; attitude is a direction
cosine matrix; a rotation arc is carried by its angular momentum in inertial axes with the full inertia tensor; both
go through an eighth-order adaptive integrator with dense output. Only the contribution functions of the effects are
common to both, because an effect is declared once.
"""
