"""Small recordings made on the spot."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 48, 32
P_LEFT = "70.0 0 24.0 0 0 70.0 16.0 0 0 0 1 0"
P_RIGHT = "70.0 0 24.0 -35.0 0 70.0 16.0 0 0 0 1 0"


@pytest.fixture
def save_images(rng):
    """``save_images(folder, names, dtype)`` writes noise images and returns them by name."""

    def save(folder: Path, names, dtype=np.uint8, size=(WIDTH, HEIGHT)) -> dict[str, np.ndarray]:
        folder.mkdir(parents=True, exist_ok=True)
        images = {}
        for name in names:
            top = np.iinfo(dtype).max
            images[name] = rng.integers(0, top, (size[1], size[0]), dtype=dtype, endpoint=True)
            assert cv2.imwrite(str(folder / name), images[name])
        return images

    return save


@pytest.fixture
def kitti_odometry(tmp_path, save_images):
    """A sequence of four rectified pairs with calibration, times and poses."""
    folder = tmp_path / "sequence"
    names = [f"{i:06d}.png" for i in range(4)]
    images = {
        "left": save_images(folder / "image_0", names),
        "right": save_images(folder / "image_1", names),
    }
    (folder / "calib.txt").write_text(f"P0: {P_LEFT}\nP1: {P_RIGHT}\n")
    (folder / "times.txt").write_text("0.000000000\n1.036224e-01\n0.2071\n0.310804\n")
    rows = [f"1 0 0 {0.1 * i} 0 1 0 0 0 0 1 {float(i)}" for i in range(4)]
    (folder / "poses.txt").write_text("\n".join(rows))
    return folder, images
