"""Trajectories become figures."""
