"""The measurement itself: what it sends, hears and reports."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from thermal_stereo_vo.nodes import benchmark_onboard


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))


def test_a_short_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "figures.json"
    arguments = ["--seconds", "2", "--rate", "5", "--pairs", "5", "--json", str(path)]
    assert benchmark_onboard.main(arguments) == 0
    figures = json.loads(path.read_text())
    assert figures["pairs_sent"] == 10
    assert 1.7 < figures["seconds"] < 600.0
    assert 1 <= figures["poses"] <= figures["pairs_answered"] <= 10
    latency = figures["latency_ms"]
    assert 0.5 < latency["median"] <= latency["p95"] <= latency["max"]
    own = figures["of_node"]
    assert int(own["pairs_answered"]) + int(own["pairs_dropped"]) >= figures["pairs_answered"]
    # What the node publishes arrives later than it is published.
    assert 0.0 < float(own["latency_ms_median"]) <= latency["max"]
    assert 1.0 < figures["cpu_ms_per_answer"] < 5000.0
    for key in ("memory_mb_settled", "memory_mb_end"):
        assert 80.0 < figures[key] <= figures["memory_mb_most"] + 1e-9 < 3000.0
    said = capsys.readouterr().out
    assert f"answered  {figures['pairs_answered']} of 10" in said
    assert f"p95 {latency['p95']:.1f}" in said


def test_a_node_that_ends_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--seconds", "1", "--pairs", "3", "--set", "no_such:=1"]
    assert benchmark_onboard.main(arguments) == 2
    error = capsys.readouterr().err
    assert "the onboard node ended with 2" in error
    assert "unknown setting 'no_such'" in error
