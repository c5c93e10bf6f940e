import cv2
import numpy as np
import pytest

from thermal_stereo_vo.calibration.image_sources import (
    Source,
    _stillest,
    _stretches,
    image_shots,
    simulated_truth,
)
from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.frames import RawFrame

from ..datasets.bags import bag_path, scribe


def write(folder, names, value=100):
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((6, 8), value + k, np.uint16))


def test_folders_pair_by_digits(tmp_path):
    write(tmp_path / "a", ["left_2.png", "left_10.png", "left_3.png"])
    write(tmp_path / "b", ["right_10.png", "right_2.png", "right_77.png"], value=500)
    source = Source((str(tmp_path / "a"), str(tmp_path / "b")))
    shots = image_shots(source, ("left", "right"))
    assert [(s.name, sorted(s.load)) for s in shots] == [
        ("2", ["left", "right"]),
        ("3", ["left"]),
        ("10", ["left", "right"]),
        ("77", ["right"]),
    ]
    assert shots[2].load["left"]()[0, 0] == 101
    assert shots[2].load["right"]()[0, 0] == 500


def test_patterns_and_role_folders(tmp_path):
    write(tmp_path, ["left01.png", "left02.png", "right01.png", "right02.png"])
    patterns = (str(tmp_path / "left*.png"), str(tmp_path / "right*.png"))
    assert len(image_shots(Source(patterns), ("left", "right"))) == 2
    write(tmp_path / "rig" / "visible", ["1.png"])
    write(tmp_path / "rig" / "thermal", ["1.png"])
    shots = image_shots(Source((str(tmp_path / "rig"),)), ("visible", "thermal"))
    assert sorted(shots[0].load) == ["thermal", "visible"]
    mono = image_shots(Source((str(tmp_path / "rig" / "thermal"),)), ("camera",))
    assert list(mono[0].load) == ["camera"]


def test_many_images_are_thinned_evenly(tmp_path):
    write(tmp_path / "a", [f"{k:03d}.png" for k in range(30)])
    shots = image_shots(Source((str(tmp_path / "a"),), limit=4), ("camera",))
    assert [s.name for s in shots] == ["000", "009", "019", "029"]


def test_refusals(tmp_path):
    with pytest.raises(DatasetError, match="at least 1, got 0"):
        Source((str(tmp_path),), limit=0)
    write(tmp_path / "left", ["1.png"])
    with pytest.raises(DatasetError, match=r"images of one camera only: .*right is missing"):
        image_shots(Source((str(tmp_path),)), ("left", "right"))
    with pytest.raises(DatasetError, match="holds the images of one camera only"):
        image_shots(Source((str(tmp_path / "left"),)), ("left", "right"))
    with pytest.raises(DatasetError, match="there is no folder"):
        image_shots(Source((str(tmp_path / "left"), str(tmp_path / "none"))), ("left", "right"))
    with pytest.raises(DatasetError, match="no file matches"):
        image_shots(Source((str(tmp_path / "x*.png"),)), ("camera",))
    with pytest.raises(DatasetError, match="3 sources given for 2 cameras"):
        image_shots(Source(("a", "b", "c")), ("left", "right"))
    write(tmp_path / "other", ["2.png"])
    with pytest.raises(DatasetError, match="belongs to another: files pair by the digits"):
        image_shots(Source((str(tmp_path / "left"), str(tmp_path / "other"))), ("left", "right"))
    write(tmp_path / "twice", ["a1.png", "b1.png"])
    with pytest.raises(DatasetError, match="have the same digits '1'"):
        image_shots(Source((str(tmp_path / "twice"),)), ("camera",))


def test_the_stillest_instant_of_a_stretch(rng):
    """The board moves, rests, moves; frozen repeats of the flat-field correction are not rest."""
    still = rng.integers(1000, 2000, (64, 80)).astype(np.uint16)
    noisy = still + rng.integers(0, 2, still.shape).astype(np.uint16)
    images = [np.roll(still, 9, 1), np.roll(still, 5, 1), still, noisy, noisy, np.roll(still, 7, 1)]
    instants = ({"left": RawFrame(i, 10 * k, "left", k)} for k, i in enumerate(images))
    (stretch,) = list(_stretches(instants, 6, 1))
    assert [i.frames["left"].sequence for i in stretch] == [0, 1, 2, 3, 5]
    # The first frame has nothing to be compared with; leave it out of the choice here.
    assert _stillest(stretch[1:])["left"].sequence == 3


@pytest.mark.parametrize(("count", "parts", "sizes"), [(27, 22, {1, 2}), (5, 22, {1}), (9, 3, {3})])
def test_as_many_stretches_as_asked_for(rng, count, parts, sizes):
    images = rng.integers(1000, 2000, (count, 16, 16)).astype(np.uint16)
    instants = ({"left": RawFrame(image, k, "left", k)} for k, image in enumerate(images))
    stretches = list(_stretches(instants, count, parts))
    assert len(stretches) == min(count, parts)
    assert {len(stretch) for stretch in stretches} == sizes
    assert sum(len(stretch) for stretch in stretches) == count


def test_bags_of_cameras_of_different_size(tmp_path, rng):
    """Visible and thermal, topics named or guessed; what is written is what comes out."""
    path = bag_path("mcap", tmp_path / "boards")
    small = rng.integers(3000, 3100, (3, 12, 16)).astype(np.uint16)
    large = rng.integers(0, 255, (3, 24, 32)).astype(np.uint8)
    with scribe("mcap", tmp_path / "boards") as bag:
        for k in range(3):
            bag.image("/thermal/image_raw", 10**8 * (k + 1), small[k])
            bag.image("/visible/image_raw", 10**8 * (k + 1) + 10**6, large[k])
    roles = ("visible", "thermal")
    named = ("/visible/image_raw", "/thermal/image_raw")
    for topics in ((), named):
        shots = image_shots(Source((str(path),), topics), roles)
        assert [sorted(shot.load) for shot in shots] == [["thermal", "visible"]] * 3
        for k, shot in enumerate(shots):
            np.testing.assert_array_equal(shot.load["thermal"](), small[k])
            np.testing.assert_array_equal(shot.load["visible"](), large[k])
    with pytest.raises(DatasetError, match=r"no image topic '/left'.*correct --topics"):
        image_shots(Source((str(path),), ("/left", named[1])), roles)
    with pytest.raises(DatasetError, match=r"several image topics.*choose one with --topics"):
        image_shots(Source((str(path),)), ("camera",))


def test_only_simulated_sources_know_the_truth(tmp_path):
    assert simulated_truth(Source((str(tmp_path),))) is None
    truth = simulated_truth(Source(("sim:board_mask",)))
    assert truth is not None
    assert truth.baseline_m == pytest.approx(0.268, abs=2e-3)
