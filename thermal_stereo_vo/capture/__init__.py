"""Cameras and frame grabbers; the only room that touches devices."""
