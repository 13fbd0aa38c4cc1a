"""Guidance: kinematics, closed-form slews, the slew optimal control problem, scans, surveys, exports."""
