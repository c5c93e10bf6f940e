"""Offline calibration: board views to cameras and rig, uniform views to flat-field maps."""
