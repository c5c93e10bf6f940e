"""``disparity`` and ``points2`` of the odometry node, over DDS."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from stereo_msgs.msg import DisparityImage

from thermal_stereo_vo.core.camera_info import infos_from_calibration
from thermal_stereo_vo.core.cameras import (
    LEFT,
    RIGHT,
    Camera,
    RigCalibration,
    RigCamera,
    default_T_base_rig,
)
from thermal_stereo_vo.core.transforms import exp_se3, make_transform
from thermal_stereo_vo.nodes import conversions

pytestmark = pytest.mark.timeout(900)

EYES = (LEFT, RIGHT)
PERIOD_NS = 100_000_000
QOS = QoSProfile(depth=100)
CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
BASELINE_M = 0.3
NORMAL, DISTANCE_M = np.array([0.0, -0.35, 1.0]), 8.0
"""The ramp of the fixture: NORMAL . p = DISTANCE_M in world axes."""


class Rig:
    """Publishes rectified pairs of the ramp, 8 cm farther ahead each time."""

    def __init__(self, ros, ramp) -> None:
        self._ros, self._ramp = ros, ramp
        T_left_right = make_transform(np.eye(3), [BASELINE_M, 0.0, 0.0])
        self._mounted = {LEFT: RigCamera(CAMERA), RIGHT: RigCamera(CAMERA, T_left_right)}
        self.statuses: list[DiagnosticArray] = []
        self.health: list[DiagnosticArray] = []
        node = ros.node
        node.create_subscription(DiagnosticArray, "status", self.statuses.append, QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self.health.append, QOS)
        self._images = {e: node.create_publisher(Image, f"{e}/image_rect", QOS) for e in EYES}
        infos = {e: node.create_publisher(CameraInfo, f"{e}/camera_info", QOS) for e in EYES}
        fields = infos_from_calibration(RigCalibration(self._mounted, rectified=True))

        def send_infos() -> None:
            for eye in EYES:
                infos[eye].publish(conversions.camera_info_to_msg(fields[eye], 0, f"{eye}_optical"))

        node.create_timer(0.5, send_infos)
        self._step = 0
        ros.spin_until(
            lambda: all(p.get_subscription_count() > 0 for p in self._images.values()),
            "the node to ask for images",
        )

    def T_world_rig(self, stamp_ns: int) -> np.ndarray:
        return exp_se3([0.0, 0.0, 0.08 * (stamp_ns // PERIOD_NS - 1), 0.0, 0.0, 0.0])

    def fly_on(self) -> None:
        """One more pair, and its status."""
        self._step += 1
        stamp_ns, before = self._step * PERIOD_NS, len(self.statuses)
        T_world_rig = self.T_world_rig(stamp_ns)
        for eye, mounted in self._mounted.items():
            image = self._ramp.image(CAMERA, T_world_rig @ mounted.T_rig_camera)
            self._images[eye].publish(conversions.image_to_msg(image, stamp_ns, f"{eye}_optical"))
        self._ros.spin_until(lambda: len(self.statuses) > before, "a status")

    def fly_until(self, condition, what: str) -> None:
        for _ in range(60):
            if condition():
                return
            self.fly_on()
        raise AssertionError(f"still waiting for {what}\n{self._ros.logs()}")

    def maps_made(self) -> int:
        """As the next diagnostics tell."""
        self.health.clear()
        self._ros.spin_until(lambda: bool(self.health), "diagnostics")
        return int({v.key: v.value for v in self.health[-1].status[0].values}["dense_maps"])


def columns(message: PointCloud2) -> dict[str, np.ndarray]:
    names = [field.name for field in message.fields]
    table = np.frombuffer(message.data, "<f4").reshape(message.width, len(names))
    return dict(zip(names, table.T, strict=True))


def test_dense_clouds_lie_where_the_scene_is_and_only_for_listeners(ros, textured_ramp) -> None:
    ros.start(
        "stereo_odometry_node",
        dense__rate_hz=5.0,
        dense__disparities=48,
        thermometer__planck_r=400_000.0,
    )
    rig = Rig(ros, textured_ramp)
    for _ in range(4):
        rig.fly_on()
    assert rig.maps_made() == 0

    disparities: list[DisparityImage] = []
    clouds: list[PointCloud2] = []
    ros.node.create_subscription(DisparityImage, "disparity", disparities.append, QOS)
    ros.node.create_subscription(PointCloud2, "points2", clouds.append, QOS)
    rig.fly_until(lambda: len(disparities) >= 3 and len(clouds) >= 3, "three clouds")

    message = disparities[-1]
    stamp_ns = conversions.stamp_from_msg(message.header.stamp)
    assert message.header.frame_id == "left_optical"
    assert (message.f, message.t) == (260.0, pytest.approx(BASELINE_M))
    assert (message.min_disparity, message.max_disparity) == (0.0, 47.0)
    assert message.image.encoding == "32FC1"
    image = np.frombuffer(message.image.data, "<f4").reshape(240, 320)
    given = image >= message.min_disparity
    assert np.all(image[~given] == -1.0)
    assert given.mean() > 0.7
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    rays = np.stack([(x - 160.0) / 260.0, (y - 120.0) / 260.0, np.ones(x.shape)], axis=-1)
    T = rig.T_world_rig(stamp_ns)
    truth_m = (DISTANCE_M - T[:3, 3] @ NORMAL) / (rays @ (T[:3, :3].T @ NORMAL))
    depth_m = message.f * message.t / image[given]
    assert np.median(np.abs(depth_m / truth_m[given] - 1.0)) < 0.02
    assert abs(np.median(depth_m / truth_m[given] - 1.0)) < 0.01

    cloud = columns(clouds[-1])
    assert list(cloud) == ["x", "y", "z", "intensity", "temperature"]
    assert clouds[-1].header.frame_id == "odom"
    world = np.column_stack([cloud[c] for c in "xyz"]) @ default_T_base_rig()[:3, :3]
    off_m = (world @ NORMAL - DISTANCE_M) / np.linalg.norm(NORMAL)
    assert abs(np.median(off_m)) < 0.1
    assert np.median(np.abs(off_m)) < 0.15
    assert 100.0 < np.median(cloud["temperature"]) < 1000.0
    # Five a second of the ten that come: never two in a row.
    stamps = [conversions.stamp_from_msg(m.header.stamp) for m in disparities]
    assert np.diff(stamps).min() >= 2 * PERIOD_NS
