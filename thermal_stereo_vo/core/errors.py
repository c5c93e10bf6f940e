"""The errors a caller can act on.  Each message says what is wrong, where, and what to do."""


class ThermalStereoError(Exception):
    """Base of every error raised on purpose: wrong use or unreadable input (exit code 2)."""


class ConfigError(ThermalStereoError):
    """Settings that are unknown, out of range or contradict each other; lists all of them."""


class CalibrationError(ThermalStereoError):
    """A calibration that is missing, unreadable or physically impossible."""


class DatasetError(ThermalStereoError):
    """A recording that cannot be read, or that lacks what was asked for."""


class FrameError(ThermalStereoError):
    """A frame of the wrong shape or type for the stage it was given to."""


class OutOfOrderError(FrameError):
    """A frame whose stamp does not lie after the one before it."""


class EvaluationError(ThermalStereoError):
    """Trajectories that cannot be compared."""


class CaptureError(ThermalStereoError):
    """A camera or frame grabber that refuses, stalls or has gone."""


class SimulationError(ThermalStereoError):
    """A simulation that cannot be built from the settings given."""
