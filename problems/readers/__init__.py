"""Readers of measured data: formats and no mathematics."""
