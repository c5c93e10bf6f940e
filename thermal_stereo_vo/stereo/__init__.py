"""Two cameras become one rectified rig frame."""
