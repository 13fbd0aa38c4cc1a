"""Where should star sensors look, or which stars should be sighted, so that the attitude is known best?

Every sighted direction tells the attitude about the two axes across it and nothing about the turn around it. The
answer therefore depends on what the attitude is for: ``K0`` is the variance of the whole attitude (trace of its
covariance), ``K1`` the mean square error of one body axis, an antenna's or a telescope's (Sukhovilov 2007).

    criteria.py             K0 and K1 as CasADi functions: equal, unequal and two-axis accuracies
    closed_form.py          the published formulas, as an independent computation
    optimal_directions.py   the best directions by IPOPT, with limits between sensors, keep-out cones, fixed sensors
    optimal_family.py       all optima: how many dimensions the family has, its members, its senses
    catalogue_selection.py  the best stars of the real sky, with a proof or a stated gap
    sighting_plan.py        which stars to follow over an orbit
    figures.py              the sphere as an interactive page and as a picture
    commands.py             ``boresight stars``

Conventions: directions are unit vectors in body axes, one per row in NumPy and one per column in CasADi; ``sigma`` is
the standard deviation of a measured direction over both of its axes together (total), so one axis has
``sigma / sqrt(2)``; the attitude error is a rotation vector (rad) in body axes.
"""
