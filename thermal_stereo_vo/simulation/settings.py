"""Everything about a simulated run that ``--set`` may change."""

from __future__ import annotations

from dataclasses import dataclass

from thermal_stereo_vo.core.config import group, setting
from thermal_stereo_vo.simulation.weather import WEATHERS


@dataclass(frozen=True)
class WorldConfig:
    """What there is to see."""

    seed: int = setting(1, "Which town is built.", minimum=0, maximum=2**31 - 1)
    weather: str = setting("cloudy_day", "Weather and time of day.", choices=tuple(WEATHERS))
    air_celsius: float | None = setting(
        None,
        "Air temperature; empty keeps the weather's.",
        unit="degC",
        minimum=-40.0,
        maximum=50.0,
    )
    illumination: float | None = setting(
        None,
        "Visible light relative to full daylight; 0.01 is dusk, 0.0001 a street without lamps; "
        "empty keeps the weather's.",
        minimum=1e-6,
        maximum=2.0,
    )
    target_kelvin: float = setting(
        25.0, "How much warmer than the air a heated target is.", unit="K", minimum=-100.0,
        maximum=300.0,
    )  # fmt: skip
    contrast: float = setting(
        1.0,
        "Factor on the temperature texture of all surfaces that the weather asks for.",
        minimum=0.0,
        maximum=10.0,
    )
    traffic: bool = setting(True, "Whether cars and people move about.")
    density: float = setting(
        1.0, "Leaves of trees and hedges relative to normal.", minimum=0.1, maximum=2.0
    )


@dataclass(frozen=True)
class FlightConfig:
    """How the rig moves."""

    length_m: float | None = setting(
        None, "Distance flown; empty keeps the preset's.", unit="m", minimum=1.0, maximum=20000.0
    )
    speed_m_s: float = setting(
        4.5, "Speed on straight legs.", unit="m/s", minimum=0.2, maximum=12.0
    )
    yaw_rate_deg_s: float = setting(
        34.0, "Fastest turn about the vertical.", unit="deg/s", minimum=5.0, maximum=180.0
    )
    height_m: float = setting(3.0, "Height above the road.", unit="m", minimum=0.5, maximum=30.0)
    gust_m: float = setting(
        0.05, "Wobble about the wanted path, standard deviation.", unit="m", minimum=0.0,
        maximum=1.0,
    )  # fmt: skip
    tilt_down_deg: float = setting(
        4.0, "How far the rig looks below the nose of the airframe.", unit="deg", minimum=-30.0,
        maximum=60.0,
    )  # fmt: skip
    seed: int = setting(1, "Which gusts blow.", minimum=0, maximum=2**31 - 1)


@dataclass(frozen=True)
class RenderConfig:
    """How pictures are made."""

    scale: float = setting(1.0, "Image size relative to 640x480.", minimum=0.05, maximum=1.0)
    edge_rays: int = setting(
        2,
        "Rays inside a pixel that shows an edge, beside its corners; targets use 16.",
        minimum=2,
        maximum=64,
    )
    lag: str = setting(
        "reprojected",
        "How motion smears a bolometer: one picture shifted along its optical flow, or "
        "lag_samples pictures rendered at times past.",
        choices=("reprojected", "rendered", "none"),
    )
    lag_samples: int = setting(
        8, "Instants that make up one smeared picture.", minimum=1, maximum=256
    )
    row_time_us: float = setting(
        0.0, "Read-out time between rows; 0 is a global shutter.", unit="us", minimum=0.0,
        maximum=200.0,
    )  # fmt: skip
    workers: int = setting(
        2, "Processes that render; 0 renders in this one.", unit="processes", minimum=0, maximum=64
    )
    cache: str = setting(
        "", "Folder that keeps the noise-free pictures for the next run; empty keeps none."
    )


@dataclass(frozen=True)
class ThermalCameraConfig:
    """A Tau 2: an uncooled 14-bit core.  Ratios are to the NETD."""

    netd_mk: float = setting(
        50.0, "Temporal noise of a pixel at 300 K.", unit="mK", minimum=0.0, maximum=1000.0
    )
    slow_noise: float = setting(
        0.25, "1/f noise of a pixel, wandering within a second.", unit="NETD", minimum=0.0,
        maximum=10.0,
    )  # fmt: skip
    row_noise: float = setting(
        0.12, "Temporal noise common to a row.", unit="NETD", minimum=0.0, maximum=10.0
    )
    column_noise: float = setting(
        0.12, "Temporal noise common to a column.", unit="NETD", minimum=0.0, maximum=10.0
    )
    counts_per_kelvin: float = setting(
        30.0, "Responsivity at 300 K.", unit="counts/K", minimum=1.0, maximum=200.0
    )
    offset_counts: float = setting(
        5000.0, "Counts of a scene that does not radiate.", unit="counts", minimum=0.0,
        maximum=12000.0,
    )  # fmt: skip
    time_constant_ms: float = setting(
        10.0, "First-order lag of the bolometers; 0 has none.", unit="ms", minimum=0.0,
        maximum=1000.0,
    )  # fmt: skip
    blur_px: float = setting(
        0.5, "Gaussian of optics and crosstalk, beyond the pixel's own aperture.", unit="px",
        minimum=0.0, maximum=3.0,
    )  # fmt: skip
    gain_percent: float = setting(
        0.3, "Gain non-uniformity from pixel to pixel.", unit="%", minimum=0.0, maximum=10.0
    )
    fixed_pixel: float = setting(
        0.5, "Pixel pattern left by a flat-field correction.", unit="NETD", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip
    fixed_column: float = setting(
        0.4, "Column pattern left by a flat-field correction.", unit="NETD", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip
    fixed_row: float = setting(
        0.3, "Row pattern left by a flat-field correction.", unit="NETD", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip
    drift_pixel_mk: float = setting(
        28.0, "Growth of the pixel pattern with FPA temperature.", unit="mK/K", minimum=0.0,
        maximum=1000.0,
    )  # fmt: skip
    drift_column_mk: float = setting(
        28.0, "Growth of the column pattern with FPA temperature.", unit="mK/K", minimum=0.0,
        maximum=1000.0,
    )  # fmt: skip
    drift_row_mk: float = setting(
        14.0, "Growth of the row pattern with FPA temperature.", unit="mK/K", minimum=0.0,
        maximum=1000.0,
    )  # fmt: skip
    drift_shading_mk: float = setting(
        260.0, "Growth of the smooth shading with FPA temperature.", unit="mK/K", minimum=0.0,
        maximum=5000.0,
    )  # fmt: skip
    drift_mean_mk: float = setting(
        1500.0, "Drift of all pixels with FPA temperature.", unit="mK/K", minimum=-10000.0,
        maximum=10000.0,
    )  # fmt: skip
    creep_pixel: float = setting(
        0.3, "Pixel pattern that grows with the square root of time, after a minute.",
        unit="NETD", minimum=0.0, maximum=100.0,
    )  # fmt: skip
    dome_kelvin: float = setting(
        0.6, "Shading by lens and housing that no shutter sees, centre to corner.", unit="K",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip
    replaced_percent: float = setting(
        0.2, "Dead pixels that the camera fills from their neighbours.", unit="%", minimum=0.0,
        maximum=10.0,
    )  # fmt: skip
    stuck_pixels: int = setting(
        6, "Dead pixels that it overlooks.", unit="pixels", minimum=0, maximum=10000
    )
    flickering_pixels: int = setting(
        6, "Pixels that jump at random.", unit="pixels", minimum=0, maximum=10000
    )
    warm_up_kelvin: float = setting(
        12.0, "Rise of the FPA above the air once warm.", unit="K", minimum=0.0, maximum=40.0
    )
    warm_up_s: float = setting(
        400.0, "Time constant of the warm-up.", unit="s", minimum=1.0, maximum=10000.0
    )
    running_s: float = setting(
        300.0, "How long the camera ran before the first frame.", unit="s", minimum=0.0,
        maximum=100000.0,
    )  # fmt: skip
    telemetry: bool = setting(
        True, "Whether frames report FPA temperature and FFC state; a Tau 2 does so over serial."
    )
    output: str = setting(
        "counts", "14-bit linear counts, or 8 bits behind the camera's own gain control.",
        choices=("counts", "agc"),
    )  # fmt: skip
    agc_damping: int = setting(
        64, "AGC filter coefficient of 8-bit output.", minimum=1, maximum=255
    )


@dataclass(frozen=True)
class FfcConfig:
    """When the shutter closes."""

    mode: str = setting(
        "none", "What triggers a flat-field correction.",
        choices=("none", "periodic", "temperature"),
    )  # fmt: skip
    first_s: float = setting(
        5.0, "First periodic correction.", unit="s", minimum=0.0, maximum=100000.0
    )
    period_s: float = setting(
        180.0, "Time between periodic corrections.", unit="s", minimum=1.0, maximum=100000.0
    )
    step_kelvin: float = setting(
        0.5, "Change of FPA temperature that triggers one.", unit="K", minimum=0.05, maximum=100.0
    )
    duration_s: float = setting(
        0.5, "How long the video repeats its last frame.", unit="s", minimum=0.0, maximum=5.0
    )
    arrangement: str = setting(
        "together", "How the corrections of the second camera lie to those of the first.",
        choices=("together", "staggered", "independent"),
    )  # fmt: skip
    stagger_s: float = setting(
        3.0, "Delay of the second camera when staggered.", unit="s", minimum=0.0, maximum=1000.0
    )
    jump_counts: float = setting(
        25.0, "Standard deviation of the step of the whole picture.", unit="counts", minimum=0.0,
        maximum=2000.0,
    )  # fmt: skip


@dataclass(frozen=True)
class TimingConfig:
    """How well the grabbers keep time."""

    skew_ms: float = setting(
        0.0, "How much later the second camera sees.", unit="ms", minimum=-500.0, maximum=500.0
    )
    jitter_ms: float = setting(
        0.0, "Standard deviation of that delay.", unit="ms", minimum=0.0, maximum=100.0
    )
    hidden: bool = setting(False, "Whether the stamps conceal skew and jitter.")
    dropped_percent: float = setting(
        0.0, "Frames that never arrive.", unit="%", minimum=0.0, maximum=90.0
    )
    late_percent: float = setting(0.0, "Frames stamped late.", unit="%", minimum=0.0, maximum=90.0)
    late_ms: float = setting(20.0, "How late those are.", unit="ms", minimum=0.0, maximum=1000.0)


@dataclass(frozen=True)
class VisibleCameraConfig:
    """An 8-bit machine-vision camera."""

    full_well: float = setting(
        10000.0, "Electrons of a saturated pixel.", unit="e-", minimum=100.0, maximum=1e6
    )
    read_noise: float = setting(
        8.0, "Noise of an unlit pixel.", unit="e-", minimum=0.0, maximum=1000.0
    )
    electrons: float = setting(
        4e7, "Electrons a second of a white surface in daylight.", unit="e-/s", minimum=1e3,
        maximum=1e10,
    )  # fmt: skip
    longest_ms: float = setting(10.0, "Longest exposure.", unit="ms", minimum=0.01, maximum=1000.0)
    highest_gain: float = setting(8.0, "Largest amplification.", minimum=1.0, maximum=100.0)
    blur_px: float = setting(0.4, "Gaussian of the optics.", unit="px", minimum=0.0, maximum=3.0)
    dark_first_s: float = setting(
        20.0, "When the light goes out.", unit="s", minimum=0.0, maximum=100000.0
    )
    dark_s: float = setting(
        0.0, "How long it stays dark; 0 for no darkness.", unit="s", minimum=0.0, maximum=100000.0
    )

    def sees_light(self, time_s: float) -> bool:
        """Whether the light is on."""
        return not self.dark_first_s <= time_s < self.dark_first_s + self.dark_s


@dataclass(frozen=True)
class NavigationConfig:
    """The other sensors of the airframe, as a bag holds them."""

    imu_rate_hz: float = setting(
        200.0, "Inertial measurements a second.", unit="Hz", minimum=1.0, maximum=2000.0
    )
    gyro_noise: float = setting(
        1.7e-4, "Gyroscope noise density.", unit="rad/s/sqrt(Hz)", minimum=0.0, maximum=1.0
    )
    gyro_walk: float = setting(
        2e-5, "Random walk of its bias.", unit="rad/s^2/sqrt(Hz)", minimum=0.0, maximum=1.0
    )
    accelerometer_noise: float = setting(
        2e-3, "Accelerometer noise density.", unit="m/s^2/sqrt(Hz)", minimum=0.0, maximum=10.0
    )
    accelerometer_walk: float = setting(
        3e-3, "Random walk of its bias.", unit="m/s^3/sqrt(Hz)", minimum=0.0, maximum=10.0
    )
    gps_rate_hz: float = setting(
        5.0, "Satellite fixes a second.", unit="Hz", minimum=0.1, maximum=50.0
    )
    gps_noise_m: float = setting(0.4, "White error of a fix.", unit="m", minimum=0.0, maximum=100.0)
    gps_wander_m: float = setting(
        1.2, "Slow error of the fixes, correlated over a minute.", unit="m", minimum=0.0,
        maximum=100.0,
    )  # fmt: skip


@dataclass(frozen=True)
class SimulationConfig:
    """One simulated run."""

    rate_hz: float = setting(10.0, "Frames a second.", unit="Hz", minimum=0.5, maximum=2000.0)
    rig: str = setting(
        "preset",
        "The cameras that fly: those of the preset, two thermal ones, or a visible and a thermal.",
        choices=("preset", "stereo", "visible_thermal"),
    )
    duration_s: float | None = setting(
        None, "Stop after this time; empty runs to the end.", unit="s", minimum=0.0,
        maximum=100000.0,
    )  # fmt: skip
    world: WorldConfig = group(WorldConfig, "What there is to see.")
    flight: FlightConfig = group(FlightConfig, "How the rig moves.")
    render: RenderConfig = group(RenderConfig, "How pictures are made.")
    thermal: ThermalCameraConfig = group(ThermalCameraConfig, "The thermal cameras.")
    ffc: FfcConfig = group(FfcConfig, "Flat-field corrections.")
    timing: TimingConfig = group(TimingConfig, "Synchronisation of the cameras.")
    visible: VisibleCameraConfig = group(VisibleCameraConfig, "The visible camera.")
    navigation: NavigationConfig = group(NavigationConfig, "Inertial and satellite sensors.")
