"""Simulation, metrics, experiments and benchmarks. No ROS."""
