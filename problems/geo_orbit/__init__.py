"""Which question: where is the satellite, how does it move, and what acts on it that the model does not know?

``orbit_problem(model)`` makes the ONE joint nonlinear least-squares problem of a set of tracking data: position and
velocity at the epoch, force parameters, burns, biases and places of stations. Residuals: ranges, range rates,
azimuth and elevation, direction cosines, of any number of stations and bistatic pairs. The orbit may be any that
stays above the air, from a transfer orbit to the geostationary one. :mod:`problems.geo_orbit.book` holds the system
of the book (spherical coordinates, 14 components, its simulation scheme) with all its filters.
"""
