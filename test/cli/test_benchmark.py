"""The measurements, each on something small; no time is asserted, only what times must obey."""

from __future__ import annotations

import json
import re
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermal_stereo_vo.benchmarks import contest as contests
from thermal_stereo_vo.benchmarks import gaps, scaling
from thermal_stereo_vo.benchmarks.extrinsics import with_yaw
from thermal_stereo_vo.benchmarks.recorded import Recorded
from thermal_stereo_vo.benchmarks.solvers import comparison_report, load_steps
from thermal_stereo_vo.cli.main import main
from thermal_stereo_vo.core.cameras import Camera, DistortionModel, RigCalibration, RigCamera
from thermal_stereo_vo.core.errors import ConfigError, DatasetError
from thermal_stereo_vo.core.results import OdometryResult, TrackingStatus
from thermal_stereo_vo.core.trajectory import Trajectory
from thermal_stereo_vo.core.transforms import exp_se3
from thermal_stereo_vo.odometry import solver_comparison

PAIRS = 20
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def recorded(room):
    """A short flight through the room, in memory."""
    poses = room.path(PAIRS, step=(0.02, 0.0, 0.06, 0.0, 0.004, 0.0))
    stamps = np.arange(PAIRS) * PERIOD_NS
    frames = tuple(room.raw_frames(stamps, poses, np.random.default_rng(5)))
    truth = Trajectory(stamps, poses)
    return Recorded("room", ("left", "right"), room.calibration(), frames, truth)


@pytest.fixture(scope="module")
def drive(room, recorded, tmp_path_factory):
    """The same flight as a folder in the layout of KITTI."""
    folder = tmp_path_factory.mktemp("drives") / "drive"
    for raw in recorded.frames:
        eye = recorded.cameras.index(raw.camera)
        path = folder / f"image_{eye}" / f"{raw.sequence:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), raw.image)
    camera = room.camera
    rows = []
    for eye in range(2):
        shift = -eye * camera.fx * room.baseline_m
        row = [camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        rows.append(f"P{eye}: " + " ".join(map(str, row)))
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    np.savetxt(folder / "poses.txt", recorded.truth.T_world_rig[:, :3].reshape(-1, 12))
    return folder


# ------------------------------------------------------------------------------------------ stages


def test_stages_in_turns_with_the_baseline(drive, tmp_path, capsys):
    out = tmp_path / "times.json"
    arguments = ["--source", str(drive), "--frames", "10", "--repeat", "2", "--output", str(out)]
    assert main(["benchmark", *arguments]) == 0
    text = capsys.readouterr().out
    assert "drive: 10 pairs of 320x240, 8 bit, 2 times; milliseconds a pair" in text
    for title in ("1 thread ", "2 threads ", "windowed, 1 thread", "frame to frame, 2 threads"):
        assert title in text
    assert re.search(r"measured on .* cores, load .*; Python 3\.\d+", text)
    content = json.loads(out.read_text())
    assert content["machine"]["cores"] >= 1
    figures = content["figures"]
    found = {(each["threads"], each["contender"]): each for each in figures}
    assert len(found) == len(figures) == 6
    for (threads, contender), each in found.items():
        assert each["pairs"] == 20
        wall, cpu = each["wall_ms"], each["cpu_ms"]
        assert 0.0 < wall["median"] <= wall["p95"] <= wall["max"]
        assert cpu > 0.0
        if threads == 1:  # one thread cannot compute for longer than it takes
            assert cpu < wall["max"] + 5.0
        baseline = found[threads, "OpenCV baseline"]["wall_ms"]["median"]
        assert each["ratio_to_baseline"] == pytest.approx(wall["median"] / baseline)
        assert 0.0 < each["metrics"]["final_error_m"] < 0.05
        stages = each["stages_ms"]
        if contender == "OpenCV baseline":
            assert stages == {}
        else:
            assert {"front end", "rectify", "agc"} < set(stages)
            assert sum(stage["median"] for stage in stages.values()) < 2 * wall["max"]
    # Two passes and another number of threads change nothing in what is estimated.
    for contender in ("windowed", "frame to frame", "OpenCV baseline"):
        one, two = (found[n, contender]["metrics"]["final_error_m"] for n in (1, 2))
        assert one == two


def test_pace_of_a_direct_method(drive, tmp_path, capsys):
    out = tmp_path / "pace.json"
    arguments = ["--source", str(drive), "--method", "direct", "--frames", "12", "--threads", "2"]
    often = ["--set", "odometry.direct.keyframes.parallax_px=1.0"]
    assert main(["benchmark", *arguments, *often, "--output", str(out)]) == 0
    text = capsys.readouterr().out
    assert "2 threads, as fast as it goes" in text
    fast, at_rate = json.loads(out.read_text())["figures"]
    assert (fast["at_rate"], at_rate["at_rate"]) == (False, True)
    # Eleven intervals of a tenth of a second cannot be shortened.
    assert at_rate["frames_per_s"] < 12 / 1.1
    for each in (fast, at_rate):
        assert each["frames"] == 12
        assert 2 <= each["keyframes"] <= 12
        stages = each["stages_ms"]
        assert {"pyramid", "align", "keyframe", "wait for bundle"} < set(stages)
        assert 0.0 < stages["bundle"]["median"] <= stages["bundle"]["p95"]
    assert fast["keyframes"] == at_rate["keyframes"]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["simulate", "--frames", "0"], "--frames must be 1 or more, not 0"),
        (["simulate", "--workers", "0"], "--workers must be 1 or more, not 0"),
        (["simulate", "--preset", "moon"], "there is no preset 'moon'"),
        (["solvers", "--matches", "nowhere"], "nowhere holds no recorded matches"),
        (["radiometry", "--data", "nowhere"], "there is no folder nowhere"),
    ],
)
def test_wrong_use_of_what_needs_no_recording(arguments, complaint, capsys):
    assert main(["benchmark", *arguments]) == 2
    assert complaint in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--frames", "0"], "--frames must be 1 or more, not 0"),
        (["--frames", "2"], "'drive' gives 2 pairs: a measurement needs at least 3"),
        (["--repeat", "0"], "--repeat must be 1 or more, not 0"),
        (["--set", "odometry.window=0"], "leave odometry.window at 2 or more"),
        (["gaps", "--first", "0"], "pairs 0 to 29 cannot be replaced in a drive of 20 pairs"),
        (["gaps", "--first", "9", "--last", "19"], "give 1 <= --first <= --last <= 18"),
        (["scaling", "--output", "/nowhere/x.json"], "/nowhere/x.json cannot be written"),
    ],
)
def test_wrong_use_is_told_in_a_line(drive, arguments, complaint, capsys, monkeypatch):
    monkeypatch.setattr(scaling, "_trials", lambda recorded, config: iter(()))
    assert main(["benchmark", *arguments, "--source", str(drive)]) == 2
    out, err = capsys.readouterr()
    assert out == "" or "scaling" in arguments
    assert complaint in err
    assert err.count("\n") == 1


def test_what_is_said_before_the_measurement_counts_too(drive, capsys):
    assert main(["benchmark", "--source", str(drive), "--frames", "5", "gaps", "--first", "9"]) == 2
    assert "pairs 9 to 29 cannot be replaced in a drive of 5 pairs" in capsys.readouterr().err


# ----------------------------------------------------------------------------------------- contests


class Listed:
    """A contender that writes down what it is given."""

    def __init__(self, name, log, pool=None):
        self.name = name
        self._log = log
        self._pool = pool
        self.work = None

    def warm_up(self):
        self._log.append((self.name, "warm"))

    def push(self, raw):
        self._log.append((self.name, raw.sequence, raw.camera, cv2.getNumThreads()))
        if self._pool is not None:
            self.work = self._pool.submit(_compute_unlocked)
        if raw.camera == "left":
            return []
        return [OdometryResult(raw.stamp_ns, TrackingStatus.TRACKING, np.eye(4), None)]

    def take_stage_ms(self):
        return {"all": 1.0}


def _compute_unlocked():
    """Long enough to be seen, without the interpreter's lock; says how long (ms)."""
    image = np.random.default_rng(0).random((600, 600), np.float32)
    begin_s = time.thread_time()
    for _ in range(12):
        cv2.GaussianBlur(image, (0, 0), 9.0)
    return 1e3 * (time.thread_time() - begin_s)


def test_contenders_take_turns_at_each_frame(recorded):
    log = []
    before = cv2.getNumThreads()
    short = Recorded("x", ("left", "right"), recorded.calibration, recorded.frames[:6], None)
    prepared = {"b": lambda raw: gaps.replace(raw, sequence=raw.sequence + 100)}
    records = contests.contest(
        [Listed("a", log), Listed("b", log)], short, opencv_threads=1, prepare=prepared
    )
    assert cv2.getNumThreads() == before
    assert log[:2] == [("a", "warm"), ("b", "warm")]
    assert log[2:] == [
        (name, pair + offset, eye, 1)
        for pair in range(3)
        for eye in ("left", "right")
        for name, offset in (("a", 0), ("b", 100))
    ]
    assert [len(record.turns) for record in records] == [3, 3]
    assert records[0].stages_ms() == {"all": [1.0, 1.0, 1.0]}
    assert [r.stamp_ns for r in records[1].results] == [0, PERIOD_NS, 2 * PERIOD_NS]


def test_work_in_other_threads_is_over_and_counted(recorded):
    """What goes on after the answer burdens the one who began it, and nobody else."""
    one_pair = Recorded("x", ("left", "right"), recorded.calibration, recorded.frames[:2], None)
    with ThreadPoolExecutor(1) as pool:
        busy = Listed("busy", [], pool)
        busy_record, idle_record = contests.contest([busy, Listed("idle", [])], one_pair)
        assert busy.work.done()
    assert 0.9 * busy.work.result() < busy_record.cpu_ms[0] < 100 * busy.work.result()
    assert idle_record.cpu_ms[0] < 0.5 * busy_record.cpu_ms[0]


def test_waiting_ends_although_a_thread_never_does(monkeypatch):
    monkeypatch.setattr(contests, "LONGEST_WAIT_S", 0.05)
    stop = threading.Event()

    def spin():
        while not stop.is_set():
            pass

    thread = threading.Thread(target=spin)
    thread.start()
    start = time.monotonic()
    contests.wait_until_idle()
    stop.set()
    thread.join()
    assert time.monotonic() - start > 0.04


# ------------------------------------------------------------------------------------------ scaling


def test_scaling_tells_every_trial(drive, capsys, monkeypatch):
    monkeypatch.setattr(scaling, "SIZES", (0.5, 1.0))
    monkeypatch.setattr(scaling, "FEATURES", (0.5, 1.0))
    monkeypatch.setattr(scaling, "WINDOWS", (2, 7))
    assert main(["benchmark", "scaling", "--source", str(drive), "--frames", "4"]) == 0
    text = capsys.readouterr().out
    for line in ("160x120 ", "320x240 ", "2 keyframes ", "7 keyframes ", "200 ", "400 ", "600 "):
        assert re.search(rf"^{line}", text, re.MULTILINE), line
    assert len(re.findall("CPU time grows with the power -?[0-9.]+ of the ", text)) == 5


@pytest.mark.parametrize("scale", [0.5, 0.71, 1.41])
def test_a_scaled_rig_sees_points_where_the_scaled_image_has_them(scale):
    camera = Camera(
        640, 480, 500.0, 510.0, 321.0, 243.0,
        DistortionModel.RADIAL_TANGENTIAL, (-0.2, 0.05, 0.001, -0.001, 0.0),
    )  # fmt: skip
    projection = np.column_stack([camera.matrix, [-100.0, 3.0, 0.0]])
    rig = RigCalibration({"left": RigCamera(camera, projection=projection)})
    scaled = scaling.scaled_calibration(rig, scale)["left"]
    points = np.random.default_rng(0).uniform((-2, -1, 4), (2, 1, 9), (50, 3))
    width, height = scaling.scaled_size(camera.size, scale)
    ratio = np.array([width / 640, height / 480])
    assert scaled.camera.size == (width, height)
    np.testing.assert_allclose(
        scaled.camera.project(points), (camera.project(points) + 0.5) * ratio - 0.5, atol=1e-9
    )
    before, after = (
        (P @ np.column_stack([points, np.ones(50)]).T) for P in (projection, scaled.projection)
    )
    np.testing.assert_allclose(
        (after[:2] / after[2]).T, ((before[:2] / before[2]).T + 0.5) * ratio - 0.5, atol=1e-9
    )


def test_exponent_of_a_power_law():
    amounts = (100.0, 200.0, 800.0)
    trials = tuple(scaling.Trial("m", "q", str(a), a, None) for a in amounts)
    times = tuple(0.3 * a**1.5 for a in amounts)
    assert scaling.Growth("m", "q", trials, times, times, times).exponent == pytest.approx(1.5)


# --------------------------------------------------------------------------------------------- gaps


def test_gaps_are_bridged_and_told(drive, tmp_path, capsys, monkeypatch):
    out = tmp_path / "gaps.json"
    all_holes = gaps.holes
    monkeypatch.setattr(gaps, "holes", lambda *where: [all_holes(*where)[i] for i in (0, 1, 3)])
    arguments = ["--first", "10", "--last", "13", "--output", str(out)]
    assert main(["benchmark", "gaps", "--source", str(drive), *arguments]) == 0
    text = capsys.readouterr().out
    found = {each["replaced"]: each for each in json.loads(out.read_text())["figures"]}
    assert list(found) == [
        "nothing",
        "10-13, 0.4 s, both eyes, copies",
        "10-13, 0.4 s, both eyes, grey",
        "10-13, 0.4 s, left eye, grey",
    ]
    for name, each in found.items():
        blind = [10, 11, 12, 13] if "both" in name else []
        assert each["blind_pairs"] == blind, name
        assert each["metrics"]["coverage_percent"] == 100.0
        assert each["metrics"]["final_error_percent"] < 6.0
        eyes = {"left", "right"} if "both" in name else {"left"} if "left" in name else set()
        assert {event.split("'")[1] for event in each["events"]} == eyes
    assert found["nothing"]["statuses"].startswith("I T")
    assert re.search(r"10-13, 0.4 s, both eyes, grey .* exactly  I .*G4 ", text)
    assert "(the rig moves 0.06 m from pair to pair)" in text


def test_replaced_pairs_show_what_they_should(recorded):
    frames = list(recorded.frames)
    for kind in (gaps.COPY, gaps.GREY):
        hole = gaps.Hole(kind, ("left",), 4, 6)
        replaced = list(gaps.HoledDataset(recorded, hole).frames())
        assert [(f.camera, f.stamp_ns) for f in replaced] == [
            (f.camera, f.stamp_ns) for f in frames
        ]
        changed = [i for i in range(len(frames)) if frames[i] is not replaced[i]]
        assert changed == [8, 10, 12]  # the left eye of pairs 4, 5 and 6
        for i in changed:
            image = replaced[i].image
            if kind == gaps.COPY:
                np.testing.assert_array_equal(image, frames[6].image)
            else:
                assert image.mean() == pytest.approx(128.0, abs=0.1)
                assert image.std() == pytest.approx(1.53, abs=0.05)  # with rounding


def test_a_shutter_of_linear_counts_lies_at_the_level_of_the_scene():
    image = np.random.default_rng(0).integers(5000, 7000, (60, 80)).astype(np.uint16)
    shutter = gaps.even_grey(image, np.random.default_rng(1))
    assert shutter.dtype == np.uint16
    assert abs(float(shutter.mean()) - float(np.median(image))) < 0.2
    assert 1.4 < shutter.std() < 1.7


@pytest.mark.parametrize(("pairs", "end"), [(40, None), (45, 32), (70, 57), (200, 70)])
def test_the_long_hole_leaves_time_to_come_back(recorded, pairs, end):
    frames = tuple(
        gaps.replace(raw, stamp_ns=i * PERIOD_NS)
        for i in range(pairs)
        for raw in recorded.frames[:2]
    )
    drive = Recorded("x", ("left", "right"), recorded.calibration, frames, None)
    found = gaps.holes(drive, 20, 29)
    assert len(found) == (6 if end is None else 8)
    if end is not None:
        assert {(hole.first, hole.last, hole.eyes) for hole in found[6:]} == {
            (20, end, ("left", "right"))
        }


def test_jump_after_a_loss():
    def at(x, status=TrackingStatus.TRACKING):
        T = np.eye(4)
        T[0, 3] = x
        return OdometryResult(0, status, None if x is None else T, None)

    lost = at(None, TrackingStatus.LOST)
    assert gaps.jump_after_loss_m([at(0.0), at(5.0)]) is None
    assert gaps.jump_after_loss_m([lost, at(5.0)]) is None
    assert gaps.jump_after_loss_m([at(1.0), lost]) is None
    found = gaps.jump_after_loss_m([at(1.0), lost, lost, at(1.5), at(9.0), lost, at(9.2)])
    assert found == pytest.approx(0.5)


def test_pairs_without_an_answer_are_blind(recorded):
    short = Recorded("x", ("left", "right"), recorded.calibration, recorded.frames[:8], None)
    results = [
        OdometryResult(i * PERIOD_NS, status, np.eye(4), None)
        for i, status in [(0, TrackingStatus.INITIALISING), (1, TrackingStatus.TRACKING),
                          (3, TrackingStatus.TRACKING)]
    ]  # fmt: skip
    letters = gaps.status_letters(short, results)
    assert letters == "IT-T"
    run = gaps.HoleRun(None, letters + "TTGG", (), None, None, None)
    assert run.blind_pairs == [2, 6, 7]
    assert run.statuses == "I T - T3 G2"


def test_a_hole_must_lie_inside(recorded):
    with pytest.raises(ConfigError, match="pairs 15 to 19 cannot be replaced"):
        gaps.holes(recorded, 15, 19)
    with pytest.raises(ConfigError, match="give 1 <= --first <= --last <= 18"):
        gaps.holes(recorded, 8, 7)


# ------------------------------------------------------------------------------------------ solvers


@pytest.fixture(scope="module")
def comparison():
    sequence = solver_comparison.simulate_steps(np.random.default_rng(0), 15)
    return solver_comparison.compare_solvers(sequence)


def test_solvers_agree_and_say_so(comparison):
    assert comparison.problems == 15
    assert comparison.apart_m < 1e-6
    assert comparison.apart_rad < 1e-6
    assert 1e-4 < comparison.sigma_m < 1e-2
    for figures in (comparison.warm, comparison.cold):
        for each in figures:
            assert each.unconverged == 0
            assert 1.0 < each.evaluations < 20.0
            assert each.iterations + 1.0 == pytest.approx(each.evaluations)
            assert each.stopped_short_sigmas < 0.1
            assert each.milliseconds > 0.0
    for chain in comparison.chains:
        assert chain.unsolved == 0
        assert 0.0 < chain.final_error_percent < 3.0
    for warm, cold in zip(comparison.warm, comparison.cold, strict=True):
        assert warm.evaluations < cold.evaluations
    text = comparison_report(comparison)
    assert "run to the end, the three agree to 1e-6" in text
    assert len(re.findall(r"^(gauss_newton|levenberg_marquardt|double_dogleg) ", text, re.M)) == 9


def test_final_error_of_a_chain_is_a_share_of_the_way():
    """A truth a tenth longer than what the matches show: an eleventh is missing at the end."""
    sequence = solver_comparison.simulate_steps(np.random.default_rng(3), 1)
    # Straight on: on a winding way the end is nearer than the way is long.
    T = exp_se3([0.05, 0.0, 0.3, 0.0, 0.0, 0.0])
    poses = np.array([np.linalg.matrix_power(T, i) for i in range(13)])
    camera = sequence.camera
    rng = np.random.default_rng(0)
    steps = []
    for _ in range(12):
        points = rng.uniform((-4.0, -3.0, 5.0), (4.0, 3.0, 25.0), (200, 3))
        after = points - T[:3, 3]
        steps.append(solver_comparison.Step(camera.project(points), camera.project(after)))
    poses[:, :3, 3] *= 1.1
    longer = gaps.replace(sequence, steps=tuple(steps), T_world_left=poses)
    for chain in solver_comparison.compare_solvers(longer).chains:
        assert chain.final_error_percent == pytest.approx(100.0 / 11.0, rel=1e-3)


def test_disagreement_is_told_too(comparison):
    apart = gaps.replace(comparison, apart_m=2e-6)
    assert "the three do NOT agree to 1e-6: at most 2.0e-06 m" in comparison_report(apart)


def test_solvers_on_recorded_matches(tmp_path, capsys):
    """Written to files and read again, simulated steps give the same figures."""
    sequence = solver_comparison.simulate_steps(np.random.default_rng(1), 8)
    write_steps(tmp_path, sequence)
    loaded = load_steps(tmp_path, 2)
    assert loaded.score_from == 2
    for one, other in zip(loaded.steps, sequence.steps, strict=True):
        np.testing.assert_array_equal(one.before_px, other.before_px)
        np.testing.assert_array_equal(one.after_px, other.after_px)
    np.testing.assert_allclose(loaded.T_world_left, sequence.T_world_left, atol=1e-12)
    out = tmp_path / "solvers.json"
    assert main(["benchmark", "solvers", "--matches", str(tmp_path), "--output", str(out)]) == 0
    assert f"{tmp_path.name}: 8 problems" in capsys.readouterr().out
    figures = json.loads(out.read_text())["figures"]
    assert [chain["solver"] for chain in figures["chains"]] == list(solver_comparison.SOLVERS)
    assert len({round(chain["final_error_percent"], 3) for chain in figures["chains"]}) == 1


def write_steps(folder, sequence):
    arrays = {
        f"step_{i:03d}": np.hstack([step.before_px, step.after_px])
        for i, step in enumerate(sequence.steps)
    }
    np.savez(folder / "matches.npz", **arrays)
    np.savetxt(
        folder / "calib.txt", [[sequence.focal_px, *sequence.centre_px, sequence.baseline_m]]
    )
    np.savetxt(folder / "poses.txt", sequence.T_world_left[:, :3].reshape(-1, 12), fmt="%.17g")


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda f: (f / "matches.npz").unlink(), "holds no recorded matches"),
        (lambda f: (f / "matches.npz").write_bytes(b"PK"), "holds no recorded matches"),
        (lambda f: (f / "calib.txt").write_text("1 2 3\n"), "calib.txt with f cx cy baseline_m"),
        (lambda f: np.savez(f / "matches.npz", step_000=np.zeros((5, 4))), "8 columns"),
        (lambda f: (f / "poses.txt").write_text("1 2 3\n"), "not 1 of 3"),
        (lambda f: np.savetxt(f / "poses.txt", np.zeros((3, 12))), "each of the 4 frames"),
    ],
)
def test_matches_that_do_not_fit_are_refused(tmp_path, spoil, complaint):
    write_steps(tmp_path, solver_comparison.simulate_steps(np.random.default_rng(1), 3))
    spoil(tmp_path)
    with pytest.raises(DatasetError, match=complaint):
        load_steps(tmp_path)


def test_first_step_that_counts_must_be_there(tmp_path):
    write_steps(tmp_path, solver_comparison.simulate_steps(np.random.default_rng(1), 3))
    with pytest.raises(DatasetError, match="must lie below 3, not at 3"):
        load_steps(tmp_path, 3)


def test_steps_without_agreement_are_refused():
    noise = np.random.default_rng(0).uniform(0, 400, (40, 8))
    step = solver_comparison.Step(noise[:, :4], noise[:, 4:])
    sequence = solver_comparison.StepSequence(
        "noise", 500.0, (320.0, 240.0), 0.3, (step,), np.tile(np.eye(4), (2, 1, 1))
    )
    with pytest.raises(DatasetError, match="no step of noise has matches that agree"):
        solver_comparison.compare_solvers(sequence)


# -------------------------------------------------------------------------------------- extrinsics


def test_a_wrong_yaw_is_put_in_and_reported(tmp_path, capsys):
    arguments = ["--flights", "seq4", "--yaw", "0.4", "--length", "2", "--scale", "0.25"]
    assert main(["benchmark", "extrinsics", *arguments, "--quiet"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["flight", "yaw"]
    (row,) = [line.split() for line in lines if line.startswith("seq4")]
    assert row[1] == "+0.40"
    assert len(row) == 7


@given(st.floats(-2.0, 2.0))
def test_the_right_eye_is_turned_about_its_vertical(yaw_mrad):
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    rig = RigCalibration(
        {"left": RigCamera(camera), "right": RigCamera(camera, exp_se3([0.2] * 6))}
    )
    turned = with_yaw(rig, yaw_mrad)
    between = np.linalg.inv(rig["right"].T_rig_camera) @ turned["right"].T_rig_camera
    np.testing.assert_allclose(between, exp_se3([0, 0, 0, 0, 1e-3 * yaw_mrad, 0]), atol=1e-12)
    assert turned["left"] is rig["left"]
