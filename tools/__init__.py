"""Console commands."""

import os

# OpenMP reads this when torch is imported. Its threads would otherwise spin while they wait, and
# take the cores from the physics and from whatever else the machine does.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
