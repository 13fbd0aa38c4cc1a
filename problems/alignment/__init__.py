"""Alignment of antenna, star tracker and actuators, and the inertia tensor, from one campaign of flight data."""
