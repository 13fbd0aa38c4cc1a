"""The joint estimator: unknowns, residuals, problems, solvers, effects and the search for missing ones."""
