"""Images larger than the middleware's own shared memory reach another process."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from thermal_stereo_vo.nodes import conversions
from thermal_stereo_vo.nodes.transport import PROFILE, VARIABLE, make_room_for_images

IMAGES = 20
SENDER = f"""
import time
import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from thermal_stereo_vo.nodes.conversions import image_to_msg
from thermal_stereo_vo.nodes.transport import make_room_for_images

make_room_for_images()
rclpy.init()
node = rclpy.create_node("sender")
qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
out = node.create_publisher(Image, "image", qos)
message = image_to_msg(np.arange(1024 * 1024, dtype=np.uint16).reshape(1024, 1024), 7, "")
while out.get_subscription_count() == 0:
    time.sleep(0.05)
time.sleep(0.5)
for _ in range({IMAGES}):
    out.publish(message)
    time.sleep(0.05)
time.sleep(3.0)
"""


def test_images_arrive_though_nobody_asks_again(ros) -> None:
    received: list[Image] = []
    qos = QoSProfile(depth=IMAGES, reliability=ReliabilityPolicy.BEST_EFFORT)
    ros.node.create_subscription(Image, "image", received.append, qos)
    with subprocess.Popen([sys.executable, "-c", SENDER]) as sender:
        # By default next to none arrives; on a busy machine some may be missed.
        ros.spin_until(lambda: len(received) >= IMAGES // 2 or sender.poll() is not None, "images")
        sender.wait()
        assert sender.returncode == 0
    assert len(received) >= IMAGES // 2
    image = conversions.image_from_msg(received[0])
    assert image.shape == (1024, 1024)
    assert (image[0, 5], image[63, 1023], image[64, 0]) == (5, 65535, 0)


def test_settings_of_the_user_come_first() -> None:
    fresh: dict[str, str] = {}
    make_room_for_images(fresh)
    assert fresh == {VARIABLE: str(PROFILE)}
    assert PROFILE.is_file()
    for name in (VARIABLE, "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"):
        own = {name: "mine"}
        make_room_for_images(own)
        assert own == {name: "mine"}
