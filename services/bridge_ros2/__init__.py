"""Connects a robot in ROS 2, without ROS installed."""
