"""Logs of other programs: CARMEN, ROS 1 and 2, arrays in an .npz; told apart by content, read scan by scan."""
