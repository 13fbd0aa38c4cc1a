"""What all tests share: one thread of linear algebra for each worker, and no test that depends on how fast it runs."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before the first import of NumPy; two workers share two cores
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import HealthCheck, settings

settings.register_profile("boresight", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("boresight")
