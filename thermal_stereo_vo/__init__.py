"""Thermal stereo odometry for a quadrotor with two long-wave infrared cameras."""

__version__ = "0.1.0"
