"""A room of textured walls, seen by a moving stereo rig: exact, small and fast to draw.

Nothing here is shared with the package's simulator, so that both can be wrong only separately.
"""

from __future__ import annotations

import cv2
import numpy as np

from thermal_stereo_vo.core.cameras import Camera, RigCalibration, RigCamera
from thermal_stereo_vo.core.frames import CameraView, RawFrame, RigFrame
from thermal_stereo_vo.core.transforms import exp_se3, make_transform

TEXELS_PER_M = 40.0


class TexturedRoom:
    """A box around the path with a stereo rig inside; world axes are those of the first camera.

    ``counts`` maps grey levels to counts: (offset, gain) of a 14-bit image.
    """

    def __init__(self, width: int = 320, height: int = 240, seed: int = 0) -> None:
        self.camera = Camera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        self.baseline_m = 0.25
        # x from -4 to 5, y from -3 to 2.5, z from -6 to 14 m.
        self.low, self.high = np.array([-4.0, -3.0, -6.0]), np.array([5.0, 2.5, 14.0])
        rng = np.random.default_rng(seed)
        self.textures = [self._texture(rng) for _ in range(6)]

    @staticmethod
    def _texture(rng):
        """(800, 800) grey levels with detail from 10 cm to 1 m."""
        total = np.zeros((800, 800), np.float32)
        for cells, weight in ((25, 1.0), (70, 0.8), (180, 0.5)):
            noise = rng.normal(size=(cells, cells)).astype(np.float32)
            total += weight * cv2.resize(noise, (800, 800), interpolation=cv2.INTER_CUBIC)
        return np.clip(128 + 38 * total, 5, 250).astype(np.float32)

    def calibration(self) -> RigCalibration:
        return RigCalibration(
            {
                "left": RigCamera(self.camera),
                "right": RigCamera(self.camera, self.T_left_right),
            },
            rectified=True,
            origin="textured room",
        )

    @property
    def T_left_right(self):
        return make_transform(np.eye(3), [self.baseline_m, 0.0, 0.0])

    def render(self, T_world_camera):
        """(H, W) float32 grey levels 0..255."""
        camera = self.camera
        x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = (
            np.stack(
                [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(x.shape)],
                axis=-1,
            )
            @ T_world_camera[:3, :3].T
        )
        origin = T_world_camera[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = (self.low - origin) / rays, (self.high - origin) / rays
        distance = np.where(rays > 0, to_high, to_low)
        axis = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=-1)
        nearest = np.take_along_axis(distance, axis[..., None], axis=-1)
        hit = origin + nearest * rays
        image = np.zeros(x.shape, np.float32)
        for wall in range(6):
            k, positive = wall % 3, wall >= 3
            seen = (axis == k) & (
                (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0) == positive
            )
            u, v = (hit[..., i] for i in range(3) if i != k)
            texture = self.textures[wall]
            drawn = cv2.remap(
                texture,
                ((u - self.low[0]) * TEXELS_PER_M).astype(np.float32),
                ((v - self.low[1]) * TEXELS_PER_M).astype(np.float32),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            )
            image = np.where(seen, drawn, image)
        return image

    def pair(self, T_world_left, rng=None, noise=1.0):
        """The 8-bit images of both eyes."""
        images = []
        for T in (T_world_left, T_world_left @ self.T_left_right):
            image = self.render(T)
            if rng is not None:
                image = image + rng.normal(0, noise, image.shape)
            images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        return images

    def rig_frame(self, stamp_ns, T_world_left, rng=None, masks=(None, None)) -> RigFrame:
        """A rectified rig frame with its 8-bit view."""
        views = {}
        for role, image, T, mask in zip(
            ("left", "right"), self.pair(T_world_left, rng), (np.eye(4), self.T_left_right), masks,
            strict=True,
        ):  # fmt: skip
            everywhere = np.ones(image.shape, np.bool_) if mask is None else mask
            views[role] = CameraView(
                image=image, camera=self.camera, T_rig_camera=T, mask=everywhere, display=image
            )
        return RigFrame(stamp_ns, views)

    def raw_frames(self, stamps_ns, poses, rng=None):
        """Left and right frames in turn."""
        for sequence, (stamp_ns, T) in enumerate(zip(stamps_ns, poses, strict=True)):
            for role, image in zip(("left", "right"), self.pair(T, rng), strict=True):
                yield RawFrame(image, int(stamp_ns), role, sequence)

    @staticmethod
    def path(frames, step=(0.02, 0.0, 0.06, 0.0, 0.01, 0.003)):
        """(frames, 4, 4) T_world_left of a steady, slightly curved flight."""
        poses = [np.eye(4)]
        for _ in range(frames - 1):
            poses.append(poses[-1] @ exp_se3(step))
        return np.array(poses)
