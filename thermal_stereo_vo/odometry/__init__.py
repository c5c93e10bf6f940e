"""Rectified rig frames become poses; the methods behind one interface."""
