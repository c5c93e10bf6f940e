from __future__ import annotations

import numpy as np
import pytest

from thermal_stereo_vo.core.config import with_overrides
from thermal_stereo_vo.core.errors import SimulationError
from thermal_stereo_vo.simulation import radiance_cache
from thermal_stereo_vo.simulation.presets import find_preset
from thermal_stereo_vo.simulation.simulation import Simulation

TINY = ("render.scale=0.125", "render.workers=0", "duration_s=0.4", "render.lag=none")


def run(tmp_path, *overrides: str, seed: int = 0, preset: str = "blackbody") -> list[np.ndarray]:
    config = with_overrides(
        find_preset(preset).config, (*TINY, f"render.cache={tmp_path / 'kept'}", *overrides)
    )
    return [frame.image for frame in Simulation(preset, config, seed).frames()]


@pytest.fixture
def rendered(monkeypatch) -> list[int]:
    """How many pictures each run rendered."""
    counts: list[int] = []
    original = radiance_cache.render_in_order

    def counting(plan, jobs, workers):
        jobs = list(jobs)
        counts.append(len(jobs))
        return original(plan, jobs, workers)

    monkeypatch.setattr(radiance_cache, "render_in_order", counting)
    return counts


def test_a_second_run_renders_nothing_and_sees_the_same(tmp_path, rendered) -> None:
    first, second = run(tmp_path), run(tmp_path)
    assert rendered == [len(first), 0]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def test_sensors_may_change_without_rendering_again(tmp_path, rendered) -> None:
    first = run(tmp_path)
    noisier = run(tmp_path, "thermal.netd_mk=400", seed=5)
    shuttered = run(tmp_path, "ffc.mode=periodic", "ffc.first_s=0.1", "ffc.duration_s=0.2")
    assert rendered == [len(first), 0, 0]
    spread = [np.abs(images[2] - np.median(images[2])).mean() for images in (noisier, first)]
    assert spread[0] > 1.5 * spread[1]
    np.testing.assert_array_equal(shuttered[8], shuttered[4])  # frozen, left eye


def test_pictures_missing_behind_a_shutter_are_rendered_later(tmp_path, rendered) -> None:
    shuttered = run(tmp_path, "ffc.mode=periodic", "ffc.first_s=0.1", "ffc.duration_s=0.2")
    whole = run(tmp_path)
    assert len(shuttered) == len(whole)
    assert 0 < rendered[0] < len(whole)
    assert rendered[0] + rendered[1] == len(whole)


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path, rendered) -> None:
    config = with_overrides(
        find_preset("blackbody").config, (*TINY, f"render.cache={tmp_path / 'kept'}")
    )
    frames = Simulation("blackbody", config).frames()
    stopped = [next(frames).image for _ in range(7)]
    frames.close()
    whole = run(tmp_path)
    assert rendered[1] == len(whole) - 7
    np.testing.assert_array_equal(whole[6], stopped[6])


def test_two_runs_may_fill_one_folder_at_once(tmp_path) -> None:
    plain = with_overrides(find_preset("seq4").config, TINY)
    config = with_overrides(plain, (f"render.cache={tmp_path / 'kept'}",))
    one, other = (Simulation("seq4", config).frames() for _ in range(2))
    seen = [next(one).image for _ in range(3)]
    for _ in range(7):
        next(other)
    seen += [frame.image for frame in one]
    for a, frame in zip(seen, Simulation("seq4", plain).frames(), strict=True):
        np.testing.assert_array_equal(a, frame.image)


def test_pictures_of_another_run_are_refused(tmp_path) -> None:
    run(tmp_path)
    with pytest.raises(SimulationError, match="keeps the pictures of another run: choose an empty"):
        run(tmp_path, "world.air_celsius=5")
    (tmp_path / "kept" / "pictures.json").unlink()
    with pytest.raises(SimulationError, match="is not empty and keeps no pictures"):
        run(tmp_path)


def test_the_cache_changes_nothing(tmp_path) -> None:
    config = with_overrides(find_preset("blackbody").config, TINY)
    plain = [frame.image for frame in Simulation("blackbody", config).frames()]
    for a, b in zip(plain, run(tmp_path), strict=True):
        np.testing.assert_array_equal(a, b)
