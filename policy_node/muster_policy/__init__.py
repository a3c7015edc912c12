"""Muster's policy node: runs an exported policy on a robot, as a ROS 2 node on rmw_zenoh's wire."""

__version__ = "0.1.0"
