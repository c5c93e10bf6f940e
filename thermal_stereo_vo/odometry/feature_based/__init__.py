"""Thermal stereo odometry on features (Mouats et al. 2015) and what goes beyond it."""
