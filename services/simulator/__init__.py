"""The simulated robot, in pybullet."""
