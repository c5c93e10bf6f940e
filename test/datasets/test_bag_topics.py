"""The choice of topics, from names alone."""

from __future__ import annotations

import pytest

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.datasets.bag_topics import (
    camera_info_topic,
    choose_image_topics,
    choose_truth_topic,
    is_rectified_name,
)


@pytest.mark.parametrize(
    ("topics", "left", "right"),
    [
        (["/right/image_raw", "/left/image_raw"], "/left/image_raw", "/right/image_raw"),
        (["/cam1/image_raw", "/cam0/image_raw"], "/cam0/image_raw", "/cam1/image_raw"),
        (
            ["/stereo/left/image_rect", "/stereo/right/image_rect", "/rear/image_raw"],
            "/stereo/left/image_rect",
            "/stereo/right/image_rect",
        ),
        (
            ["/boson_left/image", "/boson_right/image"],
            "/boson_left/image",
            "/boson_right/image",
        ),
        (
            ["/left/image_raw/compressed", "/right/image_raw/compressed"],
            "/left/image_raw/compressed",
            "/right/image_raw/compressed",
        ),
        (
            [
                "/zed/left/image_raw/compressed",
                "/zed/right/image_raw/compressed",
                "/zed/left/image_rect",
                "/zed/right/image_rect",
                "/zed/left/image_raw",
                "/zed/right/image_raw",
            ],
            "/zed/left/image_raw",
            "/zed/right/image_raw",
        ),
        (
            [
                "/camera/infra1/image_rect_raw",
                "/camera/infra2/image_rect_raw",
                "/camera/color/image",
            ],
            "/camera/infra1/image_rect_raw",
            "/camera/infra2/image_rect_raw",
        ),
    ],
)
def test_the_eyes_are_found(topics, left, right):
    assert choose_image_topics(topics)[0] == {"left": left, "right": right}
    assert choose_image_topics(topics[::-1])[0] == {"left": left, "right": right}


def test_visible_and_thermal_are_a_pair_of_their_own():
    roles, reason = choose_image_topics(["/thermal/image_raw", "/visible/image_raw"])
    assert roles == {"visible": "/visible/image_raw", "thermal": "/thermal/image_raw"}
    assert list(roles) == ["visible", "thermal"]
    assert "default topics" in reason


def test_the_reason_counts_other_candidates():
    topics = ["/a/left/image", "/a/right/image", "/b/left/image", "/b/right/image"]
    roles, reason = choose_image_topics(topics)
    assert roles["left"] == "/a/left/image"
    assert "chosen among 2 pairs" in reason


def test_named_topics_win():
    topics = ["/left/image_raw", "/right/image_raw", "/b/left/image", "/b/right/image"]
    roles, reason = choose_image_topics(topics, left="b/left/image", right="/b/right/image")
    assert roles == {"left": "/b/left/image", "right": "/b/right/image"}
    assert "asked for" in reason


@pytest.mark.parametrize("given", [{"left": "/b/left/image"}, {"right": "/b/right/image"}])
def test_one_named_eye_finds_the_other(given):
    topics = ["/left/image_raw", "/right/image_raw", "/b/left/image", "/b/right/image"]
    assert choose_image_topics(topics, **given)[0] == {
        "left": "/b/left/image",
        "right": "/b/right/image",
    }


@pytest.mark.parametrize(
    ("topics", "given", "text"),
    [
        (
            ["/front/image", "/back/image"],
            {},
            r"no pair of image topics .*there: /back/image, /front/image\): name them with --left",
        ),
        ([], {}, r"\(image topics there: none\)"),
        (
            ["/left/image_raw", "/right/image_raw"],
            {"left": "/left/image"},
            r"no image topic '/left/image' \(image topics there: /left/image_raw, /right/image_raw"
            r"\): correct --left-topic",
        ),
        (["/a", "/b"], {"left": "/a"}, "no image topic matches '/a' as its right eye .* --right-t"),
        (["/a", "/b"], {"left": "/a", "right": "/a"}, "both eyes are '/a': name two different"),
    ],
)
def test_a_wrong_topic_lists_the_right_ones(topics, given, text):
    with pytest.raises(DatasetError, match=text):
        choose_image_topics(topics, **given)


@pytest.mark.parametrize(
    ("image", "info"),
    [
        ("/left/image_raw", "/left/camera_info"),
        ("/stereo/left/image_rect/compressed", "/stereo/left/camera_info"),
        ("/left/image_rect_color", "/left/camera_info"),
    ],
)
def test_camera_info_lies_beside_the_image(image, info):
    assert camera_info_topic(image) == info


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/left/image_rect", True),
        ("/left/image_rect/compressed", True),
        ("/left/image_rect_color", True),
        ("/left/image_raw", False),
        ("/rectangle/image_raw", False),
    ],
)
def test_rectified_by_name(topic, rectified):
    assert is_rectified_name(topic) is rectified


def test_truth_is_found_by_name_only():
    assert choose_truth_topic(["/odom", "/ground_truth/odom"]) == "/ground_truth/odom"
    assert choose_truth_topic(["/odom"]) is None
    assert choose_truth_topic(["/odom"], "odom") == "/odom"
    with pytest.raises(DatasetError, match=r"no pose topic '/gps' \(pose topics there: /odom\)"):
        choose_truth_topic(["/odom"], "/gps")


BANDS = ["/rig/colour", "/rig/heat", "/thermal/image_raw"]


def test_cameras_of_two_bands_are_those_asked_for():
    named, reason = choose_image_topics(BANDS, visible="rig/colour", thermal="/rig/heat")
    assert named == {"visible": "/rig/colour", "thermal": "/rig/heat"}
    assert reason == "/rig/colour and /rig/heat were asked for"
    assert choose_image_topics(BANDS, visible="/rig/colour")[0]["thermal"] == "/thermal/image_raw"


def test_a_bag_of_one_band_says_which_is_missing():
    with pytest.raises(DatasetError, match="has /visible/image_raw but no /thermal/image_raw"):
        choose_image_topics(["/visible/image_raw", "/rig/heat"])


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"visible": "/rig/color", "thermal": "/rig/heat"}, "correct --visible-topic"),
        ({"thermal": "/rig/heat"}, r"no image topic '/visible/image_raw'.*--visible-topic"),
        ({"visible": "/rig/heat", "thermal": "/rig/heat"}, "name two different topics"),
        ({"visible": "/rig/colour", "left": "/rig/heat"}, "either left and right or visible"),
    ],
)
def test_cameras_of_two_bands_that_are_not_there_are_refused(asked, message):
    with pytest.raises(DatasetError, match=message):
        choose_image_topics(BANDS, **asked)
