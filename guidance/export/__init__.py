"""Attitude and orbit files that other tools read: AEM, OEM, SPICE CK, STK, CSV, NetCDF."""
