"""Sources that are nothing we know are refused with what was looked for."""

from __future__ import annotations

import pytest

from thermal_stereo_vo.core.errors import DatasetError, ThermalStereoError
from thermal_stereo_vo.datasets.registry import SourceOptions, open_dataset


def test_a_path_that_is_not_there(tmp_path):
    with pytest.raises(DatasetError, match=r"there is no recording .*nowhere: give a folder"):
        open_dataset(tmp_path / "nowhere")


def test_an_empty_folder(tmp_path):
    with pytest.raises(DatasetError, match="is empty: give the folder of a recording"):
        open_dataset(tmp_path)


def test_an_unknown_folder(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(
        DatasetError,
        match=r"looked for image_0 \+ image_1, .* cam0 \+ cam1 \(EuRoC\), left \+ right",
    ):
        open_dataset(tmp_path)


def test_an_unknown_file(tmp_path):
    path = tmp_path / "video.mp4"
    path.touch()
    with pytest.raises(DatasetError, match=r"bag file ending in \.bag, \.db3, \.mcap"):
        open_dataset(path)


def test_a_simulated_run_is_opened_by_name():
    name = "hover"
    dataset, reason = open_dataset(f"sim:{name}", SourceOptions(length_m=5.0))
    assert reason == f"simulated run '{name}'"
    assert dataset.name == name
    assert len(dataset.cameras) >= 2


def test_an_unknown_preset_is_refused():
    with pytest.raises(ThermalStereoError, match="nonsense"):
        open_dataset("sim:nonsense")
