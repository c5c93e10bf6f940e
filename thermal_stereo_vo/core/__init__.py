"""The vocabulary of the package: frames, results, transforms, cameras, settings, errors.

Conventions, cited everywhere else:

* ``T_a_b`` is a (4, 4) float64 matrix that maps coordinates in b to coordinates in a:
  ``p_a = T_a_b @ p_b``; chains read ``T_a_b @ T_b_c``.
* Frames: ``rig`` is the optical frame of the rectified left camera (of the visible camera in a
  visible + thermal rig): x right, y down, z forward (REP-103 ``_optical``).  ``world`` is the rig
  frame at the first pose.  ``base`` is ``base_link``: x forward, y left, z up.
* Pixels are ``(x, y)`` = (column, row) with the centre of the first pixel at (0, 0), as in OpenCV.
* Shapes: points (N, 3), pixels (N, 2), images (H, W).
* Time is an integer number of nanoseconds, ``stamp_ns``.
* A pose covariance is (6, 6), translation (m) first, then rotation (rad), both in world axes:
  ``p_true = p + e[:3]`` and ``R_true = Exp(e[3:]) R``.
* Units are in the names: ``_px _m _rad _counts _ns _s _hz _kelvin``.
* Quaternions name their order: ``quat_xyzw`` or ``quat_wxyz``.
* Random numbers come from a ``numpy.random.Generator`` argument.
"""
