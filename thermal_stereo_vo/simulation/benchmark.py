"""How fast a run is rendered and sensed, and how much memory that takes."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.settings import SimulationConfig
from thermal_stereo_vo.simulation.simulation import Simulation
from thermal_stereo_vo.simulation.studio import Studio

_KILOBYTE = 1024


@dataclass(frozen=True)
class SimulationFigures:
    """Times are of pairs of 640x480 frames.

    ``pairs_per_s`` and ``start_s`` with ``workers`` processes on the clock; the ``cpu_ms`` figures
    are processor time of one pair in one process, which other load disturbs less.
    ``memory_mib`` is the largest resident size of one process, and of all together.
    """

    workers: int
    pairs: int
    start_s: float
    pairs_per_s: float
    sense_ms: float
    cpu_ms: float
    cpu_ms_lag_rendered: float
    memory_mib: float
    memory_all_mib: float

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def benchmark_simulate(
    preset: str = "corridor",
    *,
    pairs: int = 40,
    workers: int = 2,
    on_progress: Callable[[], None] = lambda: None,
) -> SimulationFigures:
    """Render ``pairs`` pairs, then sense them again from the cache."""
    config = find_preset(preset).config
    config = replace(config, duration_s=(pairs - 1) / config.rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        cached = with_overrides(
            config, (f"render.cache={Path(folder) / 'pictures'}", f"render.workers={workers}")
        )
        start = time.perf_counter()
        first = 0.0
        for count, _ in enumerate(Simulation(preset, cached).frames(), start=1):
            if count == 2:
                first = time.perf_counter()
            on_progress()
        rendered_s = time.perf_counter() - first
        # The sensor alone: everything is in the cache, and its kernel is compiled by now.
        again = Simulation(preset, cached, seed=1)
        sense_start = time.perf_counter()
        for _ in again.frames():
            on_progress()
        sense_s = time.perf_counter() - sense_start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _KILOBYTE
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / _KILOBYTE
    return SimulationFigures(
        workers=workers,
        pairs=pairs,
        start_s=first - start,
        pairs_per_s=(pairs - 1) / rendered_s,
        sense_ms=1e3 * sense_s / pairs,
        cpu_ms=_cpu_ms(preset, config),
        cpu_ms_lag_rendered=_cpu_ms(preset, with_overrides(config, ("render.lag=rendered",)), 1),
        memory_mib=max(memory, children),
        memory_all_mib=memory + workers * children,
    )


def simulate_report(figures: SimulationFigures) -> str:
    """The figures in sentences."""
    return "\n".join(
        (
            f"rendering: {figures.pairs_per_s:.1f} pairs a second with {figures.workers} "
            f"processes, after {figures.start_s:.1f} s of building the world",
            f"processor time of a pair: {figures.cpu_ms:.0f} ms, with lag rendered at sub-frame "
            f"times {figures.cpu_ms_lag_rendered:.0f} ms",
            f"sensing a pair from the cache: {figures.sense_ms:.1f} ms",
            f"memory: {figures.memory_mib:.0f} MiB in the largest process, "
            f"{figures.memory_all_mib:.0f} MiB in all",
        )
    )


def _cpu_ms(preset: str, config: SimulationConfig, pairs: int = 6) -> float:
    """Processor time of a pair in this process; the least of three passes."""
    plan = Simulation(preset, config).plan
    studio = Studio(plan)
    times = [plan.motion.duration_s * (n + 0.5) / pairs for n in range(pairs)]
    for role in plan.roles:
        studio.picture(role, times[0])  # compiles
    best = float("inf")
    for _ in range(3):
        start = time.process_time()
        for time_s in times:
            for role in plan.roles:
                studio.picture(role, time_s)
        best = min(best, (time.process_time() - start) / pairs)
    return 1e3 * best
