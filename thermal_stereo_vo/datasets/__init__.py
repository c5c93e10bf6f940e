"""Recordings, read or simulated, behind one protocol."""
