from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thermal_stereo_vo.core.errors import FrameError, OutOfOrderError
from thermal_stereo_vo.core.frames import FfcState, GapReason, RawFrame, Telemetry
from thermal_stereo_vo.radiometry.gate import (
    Cause,
    FrameGate,
    GateConfig,
    GateDecision,
    GateState,
)

PERIOD_NS = 33_333_333
AsRaw = Callable[..., RawFrame]


def flight(scene, frames: int, speed_px: float = 3.0) -> list[np.ndarray]:
    return [scene.view(speed_px * k) for k in range(frames)]


def run(gate: FrameGate, raws: Sequence[RawFrame]) -> list[GateDecision]:
    return [gate.process(raw) for raw in raws]


def blind_frames(decisions: Sequence[GateDecision]) -> list[int]:
    return [k for k, decision in enumerate(decisions) if decision.blind]


class TestFreeze:
    def test_a_freeze_as_long_as_a_correction_is_one(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 60)
        images[30:45] = [images[29]] * 15
        gate = FrameGate(camera="left")
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == list(range(30, 45))
        gap = decisions[45].gap
        assert gap is not None
        assert gap.duration_ns == 16 * PERIOD_NS
        assert gap.reason is GapReason.FFC
        assert gap.epoch_changed
        assert [decision.epoch for decision in decisions] == [0] * 45 + [1] * 15
        assert [d.gap for k, d in enumerate(decisions) if k != 45] == [None] * 59
        (event,) = gate.events
        assert event.causes == (Cause.IDENTICAL,)
        assert (event.first_sequence, event.next_sequence) == (30, 45)
        assert event.duration_ns == gap.duration_ns
        assert "ffc of 0.533 s from frame 30 to 45 (identical frames), over" in str(event)

    def test_states_go_from_tracking_over_ffc_and_settle_back(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 50)
        images[30:40] = [images[29]] * 10
        gate = FrameGate(GateConfig(settle_frames=3))
        states, settled = [], []
        for k, image in enumerate(images):
            decision = gate.process(as_raw(image, k))
            states.append(decision.state)
            settled.append(decision.settled)
            assert gate.state is decision.state
        assert states[1:30] == [GateState.TRACKING] * 29
        assert states[30:40] == [GateState.FFC] * 10
        assert states[40:43] == [GateState.SETTLE] * 3
        assert states[43:] == [GateState.TRACKING] * 7
        assert settled[30:43] == [False] * 13
        assert all(settled[43:])

    def test_frames_after_it_are_discarded_on_request(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 50)
        images[30:40] = [images[29]] * 10
        gate = FrameGate(GateConfig(discard_frames=2))
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == list(range(30, 42))
        assert decisions[42].gap.duration_ns == 13 * PERIOD_NS
        assert Cause.DISCARDED in gate.events[0].causes

    def test_a_short_one_is_no_correction(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 40)
        images[20:23] = [images[19]] * 3
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == [20, 21, 22]
        assert decisions[23].gap.reason is GapReason.FROZEN
        assert not decisions[23].gap.epoch_changed
        assert decisions[-1].epoch == 0

    def test_behind_an_analog_link_only_the_digitiser_s_noise_is_left(
        self, small_scene, as_raw: AsRaw, rng
    ):
        """Sensor noise of 1.5 counts vanishes, noise of 0.4 stays: in motion and at hover."""
        for speed in (3.0, 0.0):
            images = flight(small_scene, 60, speed)
            for k in range(30, 45):
                noise = 0.4 * rng.standard_normal(images[29].shape)
                images[k] = np.round(images[29] + noise).astype(np.uint16)
            gate = FrameGate()
            decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
            # The link adds its noise to the first frozen frame once, to the later ones twice.
            assert blind_frames(decisions) == list(range(30, 45))
            assert decisions[45].gap.reason is GapReason.FFC
            assert gate.events[0].causes == (Cause.NEAR_IDENTICAL,)

    def test_recordings_without_noise_can_be_let_through(self, small_scene, as_raw: AsRaw):
        image = small_scene.view(0)
        gate = FrameGate(GateConfig(duplicates=False))
        assert blind_frames(run(gate, [as_raw(image, k) for k in range(20)])) == []

    @settings(
        max_examples=15,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )
    @given(data=st.data())
    def test_every_stretch_is_told_once_and_by_its_full_length(self, small_scene, as_raw, data):
        """Whatever freezes when: blind frames are the frozen ones, gaps bridge good stamps."""
        images = flight(small_scene, 70)
        frozen = set()
        start = 10
        while start < 55:
            length = data.draw(st.integers(1, 12))
            frozen |= set(range(start, start + length))
            start += length + data.draw(st.integers(1, 12))
        for k in sorted(frozen):
            images[k] = images[k - 1]
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert set(blind_frames(decisions)) == {k for k in frozen if k < 70}
        last_good = 0
        gaps = 0
        for k in range(1, 70):
            if decisions[k].blind:
                assert decisions[k].gap is None
                continue
            gap = decisions[k].gap
            assert (gap is not None) == (k - last_good > 1)
            if gap is not None:
                gaps += 1
                assert gap.duration_ns == (k - last_good) * PERIOD_NS
            last_good = k
        assert gaps == len(gate.events)


class TestNativeRepeats:
    def frames(self, scene, count: int) -> list[np.ndarray]:
        """A 9 Hz core on a 30 Hz link: each image comes three or four times."""
        return list(self._views(scene, count))

    @staticmethod
    def _views(scene, count):
        views = {}
        for k in range(count):
            index = int(k * 9 / 30)
            if index not in views:
                views[index] = scene.view(9.0 * index)
            yield views[index]

    def test_a_slow_core_on_a_fast_link_is_no_freeze(self, small_scene, as_raw: AsRaw):
        gate = FrameGate()
        images = self.frames(small_scene, 150)
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == []
        assert list(gate.events) == []
        fresh = [k for k, decision in enumerate(decisions) if not decision.repeat]
        assert fresh == [k for k in range(150) if k == 0 or images[k] is not images[k - 1]]

    def test_its_real_freeze_is_found(self, small_scene, as_raw: AsRaw):
        images = self.frames(small_scene, 150)
        images[90:106] = [images[89]] * 16
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        blind = blind_frames(decisions)
        assert blind[0] <= 95
        assert set(range(96, 106)) <= set(blind)
        assert blind[-1] <= 106
        assert [event.reason for event in gate.events] == [GapReason.FFC]


class TestShutterView:
    def test_a_picture_gone_at_once_is_the_shutter(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 60)
        shading = 4.0 * np.linspace(-1, 1, images[0].shape[1]) ** 2
        for k in range(30, 45):
            images[k] = small_scene.noisy(8040.0 + shading + np.zeros(images[0].shape))
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == list(range(30, 45))
        assert decisions[45].gap.reason is GapReason.FFC
        assert decisions[45].gap.epoch_changed
        assert gate.events[0].causes[0] is Cause.SHUTTER_VIEW

    @pytest.mark.parametrize("speed_px", [4, 9, 15])
    def test_it_is_found_although_every_block_moves(self, rough_scene, as_raw: AsRaw, speed_px):
        """No quiet block tells of the sensor's noise: foliage from border to border."""
        scene = rough_scene
        images = [scene.view(speed_px * k) for k in range(60)]
        for k in range(30, 45):
            images[k] = scene.noisy(np.full(scene.shape, 8020.0))
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == list(range(30, 45))
        assert [event.causes[0] for event in gate.events] == [Cause.SHUTTER_VIEW]

    def test_the_same_flight_without_one_and_its_end_before_a_wall_are_none(
        self, rough_scene, as_raw: AsRaw
    ):
        """Fast pan from foliage onto a bland wall: the edge takes ten frames to cross the view."""
        scene = rough_scene
        height, width = scene.shape
        bland = np.full((height, 700), 8020.0)
        strip = np.concatenate([scene.wall[:height, :600], bland], axis=1)
        images = [scene.noisy(strip[:, 12 * k : 12 * k + width]) for k in range(80)]
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == []
        assert list(gate.events) == []

    def test_8_bit_grey_noise_is_found_too(self, small_scene, as_raw: AsRaw, rng):
        images = [np.clip((v - 7700) / 3, 0, 255).astype(np.uint8) for v in flight(small_scene, 40)]
        for k in range(20, 30):
            noise = 128 + 1.5 * rng.standard_normal(images[0].shape)
            images[k] = np.round(noise).astype(np.uint8)
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == list(range(20, 30))

    def test_a_slow_pan_into_a_bland_sky_is_none(self, small_scene, as_raw: AsRaw):
        """The scene leaves over the lower edge within two seconds."""
        gate = FrameGate()
        height = small_scene.shape[0]
        decisions = []
        for k in range(120):
            counts = small_scene.clean(2.0 * k)
            sky = int(height * min(max(0.0, (k - 30) / 60), 1.0))
            counts = np.vstack([np.full((sky, counts.shape[1]), 7500.0), counts[: height - sky]])
            decisions.append(gate.process(as_raw(small_scene.noisy(counts), k)))
        assert blind_frames(decisions) == []
        assert list(gate.events) == []


class TestOffsetStep:
    def images(self, scene, step: float, rng, frames: int = 60) -> list[np.ndarray]:
        pattern = 4.0 * rng.standard_normal(scene.shape)
        images = []
        for k in range(frames):
            counts = scene.clean(0.1 * k)
            images.append(scene.noisy(counts + (step + pattern if k >= 30 else 0.0)))
        return images

    def test_a_step_with_another_pattern_is_a_correction(self, small_scene, as_raw: AsRaw, rng):
        gate = FrameGate()
        images = self.images(small_scene, -40.0, rng)
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == []
        assert decisions[30].gap.reason is GapReason.FFC
        assert decisions[30].gap.duration_ns == PERIOD_NS
        assert [event.causes for event in gate.events] == [
            (Cause.OFFSET_STEP, Cause.PATTERN_CHANGE)
        ]
        assert [decision.epoch for decision in decisions] == [0] * 30 + [1] * 30

    def test_a_step_that_keeps_the_pattern_is_the_scene(self, small_scene, as_raw: AsRaw, rng):
        """A cloud opens: everything gets warmer, every pixel keeps its own noise and pattern."""
        pattern = 4.0 * rng.standard_normal(small_scene.shape)
        gate = FrameGate()
        for k in range(60):
            counts = small_scene.clean(0.1 * k) + pattern + (40.0 if k >= 30 else 0.0)
            gate.process(as_raw(small_scene.noisy(counts), k))
        assert list(gate.events) == []

    def test_something_large_before_the_lens_is_the_scene(self, small_scene, as_raw: AsRaw, rng):
        """A warm thing covers eleven twelfths of the view at once."""
        gate = FrameGate()
        thing = 60.0 + 10.0 * rng.standard_normal(small_scene.shape)
        thing[: small_scene.shape[0] // 12] = 0.0
        for k in range(60):
            counts = small_scene.clean(0.1 * k) + (thing if k >= 30 else 0.0)
            gate.process(as_raw(small_scene.noisy(counts), k))
        assert list(gate.events) == []

    def test_a_small_step_is_drift(self, small_scene, as_raw: AsRaw, rng):
        gate = FrameGate()
        images = self.images(small_scene, 5.0, rng)
        run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert list(gate.events) == []

    def test_a_jump_of_the_camera_s_own_gain_control_is_none(self, small_scene, as_raw: AsRaw):
        """8-bit video: brightness and contrast jump, the pattern does not."""
        images = []
        for k, counts in enumerate(flight(small_scene, 60)):
            gain, level = (0.4, 120) if k % 20 < 10 else (0.3, 60)
            images.append(np.clip((counts - 8000.0) * gain + level, 0, 255).astype(np.uint8))
        gate = FrameGate()
        run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert list(gate.events) == []

    def test_16_bit_video_behind_a_gain_control_can_be_declared(self, small_scene, as_raw, rng):
        gate = FrameGate(GateConfig(linear_counts=False))
        images = self.images(small_scene, -40.0, rng)
        run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert list(gate.events) == []


class TestTimeGap:
    def raws(self, scene, as_raw: AsRaw, rng, step: float) -> list[RawFrame]:
        images = TestOffsetStep().images(scene, step, rng)
        return [as_raw(image, k + (15 if k >= 30 else 0)) for k, image in enumerate(images)]

    def test_silence_is_a_gap(self, small_scene, as_raw: AsRaw, rng):
        gate = FrameGate()
        decisions = run(gate, self.raws(small_scene, as_raw, rng, 0.0))
        assert decisions[30].gap.reason is GapReason.DROPPED
        assert decisions[30].gap.duration_ns == 16 * PERIOD_NS
        assert not decisions[30].gap.epoch_changed
        assert gate.events[0].causes == (Cause.TIME_GAP,)

    def test_silence_with_a_step_is_a_correction(self, small_scene, as_raw: AsRaw, rng):
        gate = FrameGate()
        decisions = run(gate, self.raws(small_scene, as_raw, rng, 30.0))
        assert decisions[30].gap.reason is GapReason.FFC
        assert decisions[30].gap.epoch_changed

    def test_jitter_of_a_period_is_none(self, small_scene, rng):
        gate = FrameGate()
        stamp = 1
        for k, image in enumerate(flight(small_scene, 60)):
            gate.process(RawFrame(image, stamp, "left", k))
            stamp += round(PERIOD_NS * rng.uniform(0.3, 1.9))
        assert list(gate.events) == []


class TestTelemetry:
    @pytest.mark.parametrize("told", [FfcState.IN_PROGRESS, FfcState.IMMINENT])
    def test_the_camera_s_own_word(self, small_scene, as_raw: AsRaw, told):
        gate = FrameGate()
        decisions = []
        for k, image in enumerate(flight(small_scene, 40)):
            state = told if 20 <= k < 30 else FfcState.COMPLETE
            decisions.append(gate.process(as_raw(image, k, telemetry=Telemetry(ffc_state=state))))
        if told is FfcState.IN_PROGRESS:
            assert blind_frames(decisions) == list(range(20, 30))
            assert decisions[30].gap.reason is GapReason.FFC
            assert gate.events[0].causes == (Cause.TELEMETRY,)
        else:
            assert blind_frames(decisions) == []
            assert {d.state for d in decisions[20:30]} == {GateState.IMMINENT}
            assert decisions[30].state is GateState.TRACKING

    @pytest.mark.parametrize("field", ["frames_since_ffc", "time_since_ffc_ns"])
    def test_a_counter_that_starts_anew_tells_of_a_correction(self, small_scene, as_raw, field):
        gate = FrameGate()
        unit = 1 if field == "frames_since_ffc" else PERIOD_NS
        decisions = []
        for k, image in enumerate(flight(small_scene, 40)):
            since = (1000 + k if k < 20 else k - 20) * unit
            telemetry = Telemetry(**{field: since})
            decisions.append(gate.process(as_raw(image, k, telemetry=telemetry)))
        assert decisions[20].gap.reason is GapReason.FFC
        assert decisions[20].epoch == 1
        assert len(gate.events) == 1

    def test_a_counter_that_runs_on_denies_a_correction(self, small_scene, as_raw: AsRaw, rng):
        """A freeze by the link: the offsets are what they were."""
        images = flight(small_scene, 50)
        images[20:35] = [images[19]] * 15
        gate = FrameGate()
        decisions = [
            gate.process(as_raw(image, k, telemetry=Telemetry(frames_since_ffc=1000 + k)))
            for k, image in enumerate(images)
        ]
        assert decisions[35].gap.reason is GapReason.FROZEN
        assert decisions[35].epoch == 0

    def test_what_the_host_plans_is_believed(self, small_scene, as_raw: AsRaw):
        gate = FrameGate()
        gate.expect_ffc(1_000_000_000 + 20 * PERIOD_NS, 9 * PERIOD_NS)
        raws = [as_raw(image, k) for k, image in enumerate(flight(small_scene, 40))]
        decisions = run(gate, raws)
        assert blind_frames(decisions) == list(range(20, 30))
        assert gate.events[0].causes == (Cause.SCHEDULE,)
        assert decisions[30].epoch == 1


class TestFault:
    def test_a_stuck_shutter_is_told_once_while_it_lasts(self, small_scene, as_raw: AsRaw):
        images = flight(small_scene, 180)
        for k in range(30, 150):
            images[k] = small_scene.noisy(np.full(images[0].shape, 8000.0))
        told = []
        gate = FrameGate(GateConfig(ffc_max_s=2.0), "left", told.append)
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        states = [decision.state for decision in decisions]
        assert states[40] is GateState.FFC
        assert set(states[92:150]) == {GateState.FAULT}
        assert decisions[100].reason is GapReason.FAULT
        assert [event.ongoing for event in told] == [True, False]
        assert told[0].duration_ns * 1e-9 == pytest.approx(2.0, abs=0.05)
        assert told[1].reason is GapReason.FAULT
        assert decisions[150].gap.reason is GapReason.FAULT
        assert decisions[150].gap.epoch_changed
        assert states[155] is GateState.TRACKING
        assert list(gate.events) == told

    def test_a_dead_stream_is_told_by_the_clock(self, small_scene, as_raw: AsRaw):
        gate = FrameGate(GateConfig(ffc_max_s=2.0))
        assert gate.check(10**12) is None, "no frame yet is for others to tell"
        run(gate, [as_raw(image, k) for k, image in enumerate(flight(small_scene, 20))])
        last_ns = 1_000_000_000 + 19 * PERIOD_NS
        assert gate.check(last_ns + 1_500_000_000) is None
        event = gate.check(last_ns + 2_500_000_000)
        assert event is not None
        assert event.ongoing
        assert event.reason is GapReason.FAULT
        assert gate.state is GateState.FAULT
        assert gate.check(last_ns + 3_500_000_000) is None, "told once"
        decision = gate.process(as_raw(small_scene.view(70), 19 + 120))
        assert not decision.blind
        assert decision.gap.duration_ns == 120 * PERIOD_NS
        assert len(gate.events) == 2

    def test_less_noise_for_good_is_no_freeze(self, small_scene, as_raw: AsRaw):
        """A frozen picture keeps its grain; this one has lost it."""
        small_scene.noise_counts = 6.0
        images = flight(small_scene, 30, 0.0)
        small_scene.noise_counts = 1.0
        images += flight(small_scene, 60, 0.0)
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == []

    def test_a_wrong_near_identical_verdict_ends_by_itself(self, small_scene, as_raw, rng):
        """Little noise over much fixed pattern looks frozen; after 1.5 s the gate learns it."""
        pattern = 4.0 * rng.standard_normal(small_scene.shape)
        images = [small_scene.noisy(small_scene.clean(0) + pattern) for _ in range(30)]
        small_scene.noise_counts = 0.4
        images += [small_scene.noisy(small_scene.clean(0) + pattern) for _ in range(90)]
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        blind = blind_frames(decisions)
        assert 30 < blind[-1] <= 30 + 46
        assert not any(decision.blind for decision in decisions[78:])


class TestContent:
    @pytest.mark.parametrize("value", [0, 8000, 65535])
    def test_constant_images_are_corrupt(self, small_scene, as_raw: AsRaw, value):
        images = flight(small_scene, 40)
        for k in (20, 21, 22):
            images[k] = np.full(images[0].shape, value, np.uint16)
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == [20, 21, 22]
        assert decisions[21].reason is GapReason.CORRUPT
        assert decisions[23].gap.reason is GapReason.CORRUPT
        assert decisions[23].epoch == 0

    def test_a_stream_that_begins_black(self, small_scene, as_raw: AsRaw):
        black = np.zeros(small_scene.shape, np.uint16)
        images = [black] * 5 + flight(small_scene, 10)
        gate = FrameGate()
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert blind_frames(decisions) == [0, 1, 2, 3, 4]
        assert decisions[5].gap.reason is GapReason.CORRUPT

    def test_a_dead_stop_in_one_frame_is_no_event(self, small_scene, as_raw: AsRaw):
        gate = FrameGate()
        positions = [*range(0, 120, 2), *[120] * 60]
        decisions = run(gate, [as_raw(small_scene.view(x), k) for k, x in enumerate(positions)])
        assert list(gate.events) == []
        assert blind_frames(decisions) == []

    @pytest.mark.parametrize("speed", [0.0, 0.2, 20.0])
    def test_hover_and_fast_flight_are_no_events(self, small_scene, as_raw: AsRaw, speed):
        gate = FrameGate()
        images = flight(small_scene, 100, speed)
        decisions = run(gate, [as_raw(image, k) for k, image in enumerate(images)])
        assert list(gate.events) == []
        assert not any(decision.repeat or decision.blind for decision in decisions)

    def test_braking_to_hover_is_no_event(self, small_scene, as_raw: AsRaw):
        gate = FrameGate()
        x, speed = 0.0, 12.0
        for k in range(120):
            gate.process(as_raw(small_scene.view(x), k))
            x += speed
            speed = speed * 0.75 if k > 40 else speed
        assert list(gate.events) == []

    def test_a_tiny_image_is_judged_too(self, rng, as_raw: AsRaw):
        images = [rng.integers(0, 1000, (5, 7)).astype(np.uint16) for _ in range(20)]
        gate = FrameGate()
        run(gate, [as_raw(image, k) for k, image in enumerate(images)])


class TestWrongUse:
    def test_stamps_going_back_are_refused_and_nothing_is_lost(self, small_scene, as_raw: AsRaw):
        gate = FrameGate(camera="left")
        images = flight(small_scene, 30)
        for k in range(20):
            gate.process(as_raw(images[k], k))
        for stamp in (19, 7):
            with pytest.raises(OutOfOrderError, match=r"'left' sent stamp .* after .* left out"):
                gate.process(as_raw(images[20], stamp))
        later = [gate.process(as_raw(images[k], k)) for k in range(20, 30)]
        assert list(gate.events) == []
        assert not any(decision.blind or decision.gap for decision in later)

    def test_8_bits_where_14_are_configured(self, small_scene, as_raw: AsRaw):
        gate = FrameGate(GateConfig(bit_depth=14), "left")
        eight = (small_scene.view(0) // 64).astype(np.uint8)
        with pytest.raises(FrameError, match=r"8-bit image but bit_depth is 14: switch the camera"):
            gate.process(as_raw(eight, 0))
        assert not gate.process(as_raw(small_scene.view(0), 1)).blind

    def test_16_bits_where_8_are_configured(self, small_scene, as_raw: AsRaw):
        with pytest.raises(FrameError, match="16-bit image but bit_depth is 8"):
            FrameGate(GateConfig(bit_depth=8)).process(as_raw(small_scene.view(0), 0))

    def test_a_new_size_in_mid_stream(self, small_scene, as_raw: AsRaw):
        gate = FrameGate(camera="left")
        gate.process(as_raw(small_scene.view(0), 0))
        with pytest.raises(FrameError, match="from 128x96 uint16 to 64x48 uint16 images"):
            gate.process(as_raw(small_scene.view(1)[::2, ::2], 1))
        with pytest.raises(FrameError, match="to 128x96 uint8 images"):
            gate.process(as_raw(small_scene.view(1).astype(np.uint8), 1))
        gate.reset()
        gate.process(as_raw(small_scene.view(1)[::2, ::2], 0))

    def test_an_empty_image(self, as_raw: AsRaw):
        with pytest.raises(FrameError, match="empty image: check the grabber"):
            FrameGate().process(as_raw(np.zeros((0, 10), np.uint16), 0))

    def test_reset_accepts_any_stamp_and_counts_an_epoch(self, small_scene, as_raw: AsRaw):
        gate = FrameGate()
        gate.process(as_raw(small_scene.view(0), 100))
        gate.reset()
        decision = gate.process(as_raw(small_scene.view(300), 1))
        assert decision.epoch == 1
        assert decision.gap is None
        assert not decision.blind


def test_the_same_frames_give_the_same_decisions(small_scene, as_raw: AsRaw):
    images = flight(small_scene, 60)
    images[30:45] = [images[29]] * 15
    raws = [as_raw(image, k) for k, image in enumerate(images)]
    assert run(FrameGate(), raws) == run(FrameGate(), raws)
