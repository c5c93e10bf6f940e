from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermal_stereo_vo.core.errors import DatasetError
from thermal_stereo_vo.core.results import PointCloud
from thermal_stereo_vo.outputs.point_cloud_file import read_pcd, read_ply, write_pcd, write_ply

FORMATS = [(write_ply, read_ply), (write_pcd, read_pcd)]


def random_cloud(rng: np.random.Generator, n: int, warm: bool) -> PointCloud:
    return PointCloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.uniform(0, 2**14, n).astype(np.float32),
        rng.uniform(250, 350, n).astype(np.float32) if warm else None,
    )


@pytest.mark.parametrize(("write", "read"), FORMATS)
@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("n", [0, 1, 1000])
def test_round_trip_bit_for_bit(tmp_path, rng, write, read, warm, n):
    cloud = random_cloud(rng, n, warm)
    write(tmp_path / "cloud", cloud)
    again = read(tmp_path / "cloud")
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    np.testing.assert_array_equal(again.intensity, cloud.intensity)
    assert again.xyz.dtype == again.intensity.dtype == np.float32
    if warm:
        np.testing.assert_array_equal(again.temperature_kelvin, cloud.temperature_kelvin)
    else:
        assert again.temperature_kelvin is None


@pytest.mark.parametrize(("write", "read"), FORMATS)
def test_points_of_two_bands_keep_what_each_saw(tmp_path, rng, write, read):
    cloud = random_cloud(rng, 5, warm=False)
    counts = np.array([7000, np.nan, 7100.5, 0, 16383], np.float32)
    cloud.intensity[3] = np.nan
    write(tmp_path / "cloud", replace(cloud, thermal_counts=counts))
    again = read(tmp_path / "cloud")
    np.testing.assert_array_equal(again.thermal_counts, counts)
    np.testing.assert_array_equal(again.intensity, cloud.intensity)


def test_ply_is_what_the_format_demands(tmp_path):
    cloud = PointCloud(np.array([[1, 2, 3]], np.float32), np.array([4], np.float32))
    write_ply(tmp_path / "cloud.ply", cloud)
    header, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 1",
        "property float x",
        "property float y",
        "property float z",
        "property float intensity",
    ]
    assert body == np.array([1, 2, 3, 4], "<f4").tobytes()


def test_ply_is_read_by_another_program(tmp_path, rng):
    trimesh = pytest.importorskip("trimesh")
    cloud = random_cloud(rng, 50, warm=True)
    write_ply(tmp_path / "cloud.ply", cloud)
    np.testing.assert_array_equal(trimesh.load(tmp_path / "cloud.ply").vertices, cloud.xyz)


def test_ply_of_another_program_is_read(tmp_path):
    table = np.zeros(2, dtype=[("x", "<f8"), ("red", "u1"), ("y", "<f8"), ("z", "<f4")])
    table["x"], table["y"], table["z"] = [1, 2], [3, 4], [5, 6]
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 2\n"
        "property double x\nproperty uchar red\nproperty float64 y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    )
    (tmp_path / "c.ply").write_bytes(header.encode() + table.tobytes() + b"\x03abc")
    cloud = read_ply(tmp_path / "c.ply")
    assert cloud.xyz.tolist() == [[1, 3, 5], [2, 4, 6]]
    assert cloud.intensity.tolist() == [0, 0]


def test_pcd_with_padding_fields_is_read(tmp_path):
    table = np.zeros(2, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", (4,))])
    table["z"] = [7, 8]
    header = (
        "VERSION 0.7\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 4\nWIDTH 2\n"
        "HEIGHT 1\nPOINTS 2\nDATA binary\n"
    )
    (tmp_path / "c.pcd").write_bytes(header.encode() + table.tobytes())
    assert read_pcd(tmp_path / "c.pcd").xyz.tolist() == [[0, 0, 7], [0, 0, 8]]


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_ply, b"ply\nformat ascii 1.0\nend_header\n", "not a binary little-endian PLY"),
        (read_ply, b"solid stl\n", "no end of header: it is no point cloud file"),
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n",
            "does not begin with its vertices",
        ),
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
            b"property list uchar int x\nend_header\n",
            "vertex property 'list uchar int x' is not a plain number",
        ),
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
            b"property float x\nproperty float y\nend_header\n12345678",
            "has no z",
        ),
        (
            read_ply,
            b"ply\nformat binary_little_endian 1.0\nelement vertex many\nend_header\n",
            "the header of .*cloud is damaged: .*'many'",
        ),
        (read_pcd, b"DATA ascii\n", "not a PCD file with 'DATA binary'"),
        (read_pcd, b"FIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 1\nDATA binary\n", "is damaged"),
        (read_pcd, b"FIELDS x\nSIZE 4\nTYPE F\nDATA binary\n", "is damaged"),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path, read, content, message):
    (tmp_path / "cloud").write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        read(tmp_path / "cloud")


@pytest.mark.parametrize(("write", "read"), FORMATS)
def test_cut_off_and_missing_files_are_refused(tmp_path, rng, write, read):
    write(tmp_path / "cloud", random_cloud(rng, 10, False))
    whole = (tmp_path / "cloud").read_bytes()
    (tmp_path / "cloud").write_bytes(whole[:-20])
    with pytest.raises(DatasetError, match="ends after 8 of 10 points"):
        read(tmp_path / "cloud")
    with pytest.raises(DatasetError, match="gone cannot be read: No such file"):
        read(tmp_path / "gone")
