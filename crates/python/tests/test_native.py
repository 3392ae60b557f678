"""The bindings: shapes, types, errors and the interpreter lock."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import tomllib
from collections import ChainMap, UserDict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from conftest import Frame

import samsod

EXAMPLE = Path(__file__).parents[3] / "examples" / "cell.toml"


def squares_partition(rgb: Frame) -> samsod.Partition:
    """The partition of `two_squares` that any segmentation should find."""
    labels = np.zeros(rgb.shape[:2], dtype=np.uint32)
    labels[24:40, 24:40] = 1
    labels[24:40, 48:64] = 2
    return samsod.Partition.from_labels(rgb, labels)


def test_partition_arrays(frame: Frame) -> None:
    partition = samsod.segment(frame)
    height, width = frame.shape[:2]
    n = len(partition)
    assert n > 5
    assert (partition.width, partition.height) == (width, height)
    assert partition.labels.shape == (height, width)
    assert partition.labels.dtype == np.uint32
    assert partition.areas.shape == (n,)
    assert partition.areas.dtype == np.int64
    assert partition.means.shape == (n, 3)
    assert partition.means.dtype == np.float32
    assert partition.boxes.shape == (n, 4)
    assert partition.boxes.dtype == np.int64
    assert partition.centroids.shape == (n, 2)
    assert partition.centroids.dtype == np.float32


def test_labels_are_dense_and_agree_with_the_tables(frame: Frame) -> None:
    partition = samsod.segment(frame)
    labels = partition.labels
    assert np.array_equal(np.unique(labels), np.arange(len(partition)))
    assert np.array_equal(np.bincount(labels.ravel()), partition.areas)
    for label in (0, len(partition) // 2, len(partition) - 1):
        rows, columns = np.nonzero(labels == label)
        x, y, width, height = partition.boxes[label]
        assert (x, y) == (columns.min(), rows.min())
        assert (width, height) == (np.ptp(columns) + 1, np.ptp(rows) + 1)
        assert partition.centroids[label] == pytest.approx((columns.mean(), rows.mean()), abs=1e-2)
        assert partition.means[label] == pytest.approx(frame[rows, columns].mean(axis=0), abs=1e-2)


def test_labels_are_a_read_only_view(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    labels = partition.labels
    assert labels.ctypes.data == partition.labels.ctypes.data
    assert not labels.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        labels[0, 0] = 1
    del partition
    # The view keeps the memory alive.
    assert labels.sum() == 3 * 16 * 16


def test_from_labels_and_neighbours() -> None:
    rgb = np.arange(3 * 4 * 3, dtype=np.uint8).reshape(3, 4, 3)
    labels = np.array([[0, 0, 0, 1], [0, 2, 2, 1], [0, 0, 2, 1]], dtype=np.uint32)
    partition = samsod.Partition.from_labels(rgb, labels)
    assert partition.areas.tolist() == [6, 3, 3]
    assert partition.boxes.tolist() == [[0, 0, 3, 3], [3, 0, 1, 3], [1, 1, 2, 2]]
    assert partition.centroids[1].tolist() == [3.0, 1.0]
    assert partition.neighbours(0).tolist() == [1, 2]
    assert partition.neighbours(2).dtype == np.uint32
    for unknown in (3, -1, 2**40):
        with pytest.raises(IndexError, match=f"no partition {unknown}; there are 3"):
            partition.neighbours(unknown)


def test_from_labels_refuses_what_is_no_partition() -> None:
    rgb = np.zeros((2, 2, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="label 1 does not occur although 2 does"):
        samsod.Partition.from_labels(rgb, np.array([[0, 0], [2, 2]], dtype=np.uint32))
    with pytest.raises(ValueError, match="3 x 2 pixels and rgb 2 x 2"):
        samsod.Partition.from_labels(rgb, np.zeros((2, 3), dtype=np.uint32))
    # A stray value must not cost the memory of four billion objects.
    with pytest.raises(ValueError, match="dense"):
        samsod.Partition.from_labels(rgb, np.full((2, 2), 2**32 - 1, dtype=np.uint32))
    signed: Any = np.zeros((2, 2), dtype=np.int32)
    with pytest.raises(TypeError, match=r"labels: expected a C-contiguous uint32 array .* got int32 of shape"):
        samsod.Partition.from_labels(rgb, signed)


@pytest.mark.parametrize(
    ("rgb", "error", "message"),
    [
        (np.zeros((4, 4, 3)), TypeError, "uint8 array of shape .* got float64 of shape"),
        (np.zeros((4, 4), dtype=np.uint8), TypeError, "got uint8 of shape"),
        (np.zeros((4, 4, 4), dtype=np.uint8), ValueError, r"got shape \[4, 4, 4\]"),
        ([[[0, 0, 0]]], TypeError, "got list"),
        (None, TypeError, "got NoneType"),
        (np.zeros((8, 8, 3), dtype=np.uint8)[::2], ValueError, "ascontiguousarray"),
        (np.zeros((8, 8, 3), dtype=np.uint8)[:, :, ::-1], ValueError, "ascontiguousarray"),
        (np.asfortranarray(np.zeros((8, 8, 3), dtype=np.uint8)), ValueError, "ascontiguousarray"),
        (np.zeros((0, 8, 3), dtype=np.uint8), ValueError, "8 x 0 px; both sides must be 1 to"),
        (np.zeros((8, 0, 3), dtype=np.uint8), ValueError, "0 x 8 px; both sides must be 1 to"),
    ],
)
def test_frames_that_are_refused(rgb: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        samsod.segment(rgb)
    with pytest.raises(error, match=message):
        samsod.Cell().inspect(rgb)


def test_read_only_and_one_pixel_frames_are_accepted(two_squares: Frame) -> None:
    two_squares.flags.writeable = False
    assert len(samsod.segment(two_squares)) == 3
    assert len(samsod.segment(np.zeros((1, 1, 3), dtype=np.uint8))) == 1


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"spatial_bandwidth_px": float("nan")}, "spatial_bandwidth_px = NaN; allowed are 1 to"),
        ({"spatial_bandwidth_px": -3}, "spatial_bandwidth_px = -3; allowed are 1 to"),
        ({"range_bandwidth": float("nan")}, "range_bandwidth = NaN"),
        ({"range_bandwidth": float("inf")}, "range_bandwidth = inf"),
        ({"range_bandwidth": 0}, "range_bandwidth = 0"),
        ({"min_area_px": -1}, "min_area_px = -1; allowed are 0 to"),
    ],
)
def test_parameters_out_of_range(two_squares: Frame, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        samsod.segment(two_squares, **parameters)


def test_parameters_matter(frame: Frame) -> None:
    assert len(samsod.segment(frame, min_area_px=20_000)) < len(samsod.segment(frame, min_area_px=50))


@pytest.mark.parametrize("method", ["fast", "exact"])
def test_saliency(two_squares: Frame, method: Any) -> None:
    partition = squares_partition(two_squares)
    values = samsod.saliency(two_squares, partition, method)
    assert values.shape == (72, 96)
    assert values.dtype == np.float32
    assert 0.0 <= values.min() < values.max() <= 1.0
    table, red, blue = (values[partition.labels == label].mean() for label in range(3))
    assert min(red, blue) > 2 * table


@pytest.mark.parametrize("method", ["fast", "exact"])
def test_a_constant_image_has_no_saliency(method: Any) -> None:
    rgb = np.full((40, 50, 3), 77, dtype=np.uint8)
    partition = samsod.segment(rgb)
    assert len(partition) == 1
    values = samsod.saliency(rgb, partition, method)
    assert not values.any()
    assert samsod.salient_regions(values, partition) == []


def test_saliency_scales(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    generic = samsod.saliency(two_squares, partition, "exact")
    scale = 96 / 256
    same = samsod.saliency(
        two_squares,
        partition,
        "exact",
        center=[s * scale for s in (3, 5, 7)],
        surround=[s * scale for s in (19, 23, 29)],
    )
    assert same == pytest.approx(generic, abs=1e-5)
    other = samsod.saliency(two_squares, partition, "exact", center=(2.0,), surround=(20.0,))
    assert np.abs(other - generic).max() > 0.01


def test_saliency_parameters_out_of_range(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    method: Any = "best"
    with pytest.raises(ValueError, match='method = "best"; allowed are "fast" and "exact"'):
        samsod.saliency(two_squares, partition, method)
    with pytest.raises(ValueError, match="together"):
        samsod.saliency(two_squares, partition, center=[2.0])
    with pytest.raises(ValueError, match="center_px = NaN"):
        samsod.saliency(two_squares, partition, center=[float("nan")], surround=[9.0])
    with pytest.raises(ValueError, match="surround scale 3 px is not larger than center scale 4 px"):
        samsod.saliency(two_squares, partition, center=[4.0], surround=[3.0])
    with pytest.raises(ValueError, match="rgb has 96 x 71 pixels and partition 96 x 72"):
        samsod.saliency(two_squares[:-1], partition)


def test_saliency_variants(two_squares: Frame) -> None:
    partition = samsod.segment(two_squares, preset="photo")
    assert len(partition) == 3
    default = samsod.saliency(two_squares)
    assert np.array_equal(default, samsod.saliency(two_squares, partition, variant="background"))
    # One value a partition; one half parts the background from objects.
    for label in range(3):
        assert len(np.unique(default[partition.labels == label])) == 1
    table = int(partition.labels[0, 0])
    assert np.array_equal(default > 0.5, partition.labels != table)
    centred = samsod.saliency(two_squares, variant="centred")
    assert np.array_equal(centred > 0.5, default > 0.5)
    paper = samsod.saliency(two_squares, partition, variant="paper")
    assert np.array_equal(paper, samsod.saliency(two_squares, partition, "fast"))
    averaged = samsod.saliency(two_squares, partition, variant="averaged")
    for label in range(3):
        inside = partition.labels == label
        assert averaged[inside] == pytest.approx(paper[inside].mean(), abs=1e-6)


def test_saliency_variants_that_are_refused(two_squares: Frame) -> None:
    unknown: Any = "rbd"
    with pytest.raises(ValueError, match='variant = "rbd"; allowed are "paper", "averaged", "background", "centred"'):
        samsod.saliency(two_squares, variant=unknown)
    with pytest.raises(ValueError, match='variant "background" has one way'):
        samsod.saliency(two_squares, method="exact", variant="background")
    with pytest.raises(ValueError, match='variant "centred" has no scales'):
        samsod.saliency(two_squares, center=[2.0], surround=[9.0], variant="centred")
    with pytest.raises(ValueError, match='preset = "street"; allowed are "cell" and "photo"'):
        samsod.segment(two_squares, preset=unknown.replace("rbd", "street"))


def test_regions_agree_with_the_labels(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    values = samsod.saliency(two_squares, partition, variant="paper")
    regions = samsod.salient_regions(values, partition, 0.1)
    assert sorted(region.partitions for region in regions) == [[1], [2]]
    for region in regions:
        label = region.partitions[0]
        assert region.mask.shape == (72, 96)
        assert region.mask.dtype == np.bool_
        assert np.array_equal(region.mask, partition.labels == label)
        assert region.area == 256
        assert region.bbox == tuple(partition.boxes[label])
        assert region.centroid == pytest.approx(partition.centroids[label])
        assert region.mean_saliency == pytest.approx(values[region.mask].mean(), abs=1e-4)


def test_thresholds(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    values = samsod.saliency(two_squares, partition, variant="paper")
    assert samsod.salient_regions(values, partition, 1.0) == []
    everything = samsod.salient_regions(values, partition, 0.0)
    assert [region.partitions for region in everything] == [[0, 1, 2]]
    assert everything[0].mask.all()
    for threshold in (None, "positive", "adaptive", np.float32(0.1)):
        assert len(samsod.salient_regions(values, partition, threshold)) == 2  # type: ignore[arg-type]


@pytest.mark.parametrize("threshold", [float("nan"), -0.1, 1.5, "sometimes"])
def test_thresholds_out_of_range(two_squares: Frame, threshold: Any) -> None:
    partition = squares_partition(two_squares)
    values = np.zeros((72, 96), dtype=np.float32)
    with pytest.raises(ValueError, match=r'threshold = .*"positive", "adaptive"'):
        samsod.salient_regions(values, partition, threshold)


def test_saliency_maps_that_are_refused(two_squares: Frame) -> None:
    partition = squares_partition(two_squares)
    values = np.zeros((72, 96), dtype=np.float32)
    values[3, 5] = np.nan
    with pytest.raises(ValueError, match=r"saliency NaN at pixel \(5, 3\)"):
        samsod.salient_regions(values, partition)
    with pytest.raises(ValueError, match="saliency has 72 x 96 pixels and partition 96 x 72"):
        samsod.salient_regions(np.zeros((96, 72), dtype=np.float32), partition)
    with pytest.raises(ValueError, match="ascontiguousarray"):
        samsod.salient_regions(np.zeros((72, 192), dtype=np.float32)[:, ::2], partition)
    doubles: Any = np.zeros((72, 96))
    with pytest.raises(TypeError, match=r"float32 array .* got float64"):
        samsod.salient_regions(doubles, partition)
    threshold: Any = [0.1]
    with pytest.raises(TypeError, match="threshold"):
        samsod.salient_regions(np.zeros((72, 96), dtype=np.float32), partition, threshold)


def test_cell_equals_its_stages(frame: Frame) -> None:
    scene = samsod.Cell().inspect(frame)
    partition = samsod.segment(frame)
    assert np.array_equal(scene.partition.labels, partition.labels)
    # The cell has the paper's variant; what `saliency` does by default is for still photos.
    values = samsod.saliency(frame, partition, variant="paper")
    assert np.array_equal(scene.saliency, values)
    regions = samsod.salient_regions(values, partition)
    assert [r.partitions for r in scene.regions] == [r.partitions for r in regions]
    assert scene.regions
    assert [r.area for r in scene.regions] == sorted((r.area for r in scene.regions), reverse=True)
    assert list(scene.timings_ms) == ["segment", "saliency", "regions", "shadow", "recognize"]
    assert all(ms >= 0.0 for ms in scene.timings_ms.values())


def test_cell_reused_for_other_sizes(frame: Frame, two_squares: Frame) -> None:
    cell = samsod.Cell()
    first = cell.inspect(frame)
    labels = first.partition.labels.copy()
    assert len(cell.inspect(two_squares).partition) == 3
    # A scene is not touched by the frames that follow it.
    assert np.array_equal(first.partition.labels, labels)
    assert np.array_equal(cell.inspect(frame).partition.labels, labels)


def test_cell_from_dict_and_file(tmp_path: Path) -> None:
    params = {"segment": {"range_bandwidth": 12.0}, "regions": {"threshold": "adaptive"}}
    cell = samsod.Cell(params)
    assert cell.params["segment"]["range_bandwidth"] == 12.0
    assert cell.params["regions"]["threshold"] == "adaptive"
    assert samsod.Cell(cell.params).params == cell.params
    assert samsod.Cell({"regions": {"threshold": np.float64(0.25)}}).params["regions"]["threshold"] == 0.25

    file = tmp_path / "cell.toml"
    # Sections of the daemon are not the vision chain's business.
    file.write_text('[segment]\nrange_bandwidth = 12.0\n[regions]\nthreshold = "adaptive"\n[recording]\nfolder = "x"\n')
    assert samsod.Cell(file).params == cell.params
    assert samsod.Cell(str(file)).params == cell.params


def test_cell_takes_the_whole_file_of_the_daemon() -> None:
    params = samsod.Cell(EXAMPLE).params
    with EXAMPLE.open("rb") as file:
        whole = tomllib.load(file)
    # The example has every section, so none of the daemon's can be missing from the list of those passed over.
    assert set(whole) > set(params)
    assert samsod.Cell(whole).params == params


def test_cell_from_numpy_scalars() -> None:
    for integer in (np.int64, np.int32, np.uint8):
        params = samsod.Cell({"segment": {"min_area_px": integer(48), "range_bandwidth": integer(6)}}).params
        assert params["segment"]["min_area_px"] == 48
        assert params["segment"]["range_bandwidth"] == 6.0
    for real in (np.float64, np.float32):
        assert samsod.Cell({"segment": {"range_bandwidth": real(5.3)}}).params["segment"]["range_bandwidth"] == 5.3
    for one in (1, np.int64(1)):
        assert samsod.Cell({"regions": {"threshold": one}}).params["regions"]["threshold"] == 1.0


def test_cell_from_any_mapping() -> None:
    segment = {"range_bandwidth": 12.0}
    expected = samsod.Cell({"segment": segment}).params
    assert samsod.Cell(MappingProxyType({"segment": MappingProxyType(segment)})).params == expected
    assert samsod.Cell(ChainMap({"segment": ChainMap({}, segment)})).params == expected
    assert samsod.Cell(UserDict({"segment": segment})).params == expected


@pytest.mark.parametrize("value", [5.3, 1.1, 33.3, 3.14159, 254.99998, 16.0])
def test_cell_parameters_come_back_as_written(value: float) -> None:
    scales = {"object_sizes_px": [value, value * 2.0]}
    params = samsod.Cell({"segment": {"range_bandwidth": value}, "saliency": {"scales": scales}}).params
    assert params["segment"]["range_bandwidth"] == value
    assert params["saliency"]["scales"]["object_sizes_px"][0] == value
    assert samsod.Cell(params).params == params


def test_cell_scales() -> None:
    pixels = {"pixels": {"center_px": [3.3, 5.0], "surround_px": [19.7]}}
    assert samsod.Cell({"saliency": {"scales": pixels}}).params["saliency"]["scales"] == pixels


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"segment": {"colour": 3}}, "unknown field `colour`"),
        ({"colour": {}}, "unknown field `colour`"),
        ({"log": {}, "regionz": {"threshold": 0.5}}, "unknown field `regionz`"),
        ({"segment": {"range_bandwidth": float("nan")}}, "range_bandwidth = NaN"),
        ({"segment": {"range_bandwidth": "wide"}}, "wide"),
        ({"saliency": {"method": "best"}}, "best"),
        ({"regions": {"threshold": 2.0}}, "threshold = 2"),
        ({"shadow": {"object_side": "bright"}}, "unknown variant `bright`, expected `paper` or `evidence`"),
        ({"shadow": {"min_object_area_px": 0}}, "min_object_area_px = 0; allowed are 1 to"),
        ({"segment": {"min_area_px": 2**70}}, "min_area_px"),
        ({"segment": {"min_area_px": np.uint64(2**64 - 1)}}, "min_area_px = 18446744073709551615: too large"),
        ({"segment": {"min_area_px": np.True_}}, "boolean `true`, expected u32"),
    ],
)
def test_cell_parameters_that_are_refused(params: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        samsod.Cell(params)


def test_cell_files_that_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "cell.toml"
    with pytest.raises(FileNotFoundError, match=r"cell\.toml"):
        samsod.Cell(file)
    file.write_text("[segment]\ncolour = 3\n")
    with pytest.raises(ValueError, match=r"(?s)cell\.toml: .*unknown field `colour`"):
        samsod.Cell(file)
    file.write_text("[segmnt]\nrange_bandwidth = 9.0\n")
    with pytest.raises(ValueError, match=r"(?s)cell\.toml: .*unknown field `segmnt`"):
        samsod.Cell(file)
    file.write_text("[segment\n")
    with pytest.raises(ValueError, match=r"cell\.toml: TOML parse error at line 1"):
        samsod.Cell(file)
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match=r"cell\.toml"):
        samsod.Cell(file)
    number: Any = 3
    with pytest.raises(TypeError, match="config: expected the path"):
        samsod.Cell(number)
    unsuitable: Any = {"segment": {"range_bandwidth": object()}}
    with pytest.raises(TypeError, match="range_bandwidth"):
        samsod.Cell(unsuitable)


def test_a_dict_that_contains_itself_is_refused() -> None:
    endless: dict[str, Any] = {}
    endless["segment"] = endless
    with pytest.raises(ValueError, match="more than 8 levels"):
        samsod.Cell(endless)
    endless["segment"] = [endless]
    with pytest.raises(ValueError, match="more than 8 levels"):
        samsod.Cell(endless)


def test_the_interpreter_lock_is_released(frame: Frame) -> None:
    """Another Python thread gets on while the chain works."""
    cell = samsod.Cell()
    large = np.ascontiguousarray(np.tile(frame, (2, 2, 1)))
    started = threading.Event()
    done = threading.Event()
    counted = 0

    def count() -> None:
        nonlocal counted
        started.set()
        while not done.is_set():
            counted += 1

    interval = sys.getswitchinterval()
    # With the lock held, the thread would get on only in a short turn before and after each call.
    sys.setswitchinterval(1e-5)
    thread = threading.Thread(target=count)
    thread.start()
    progress = []
    try:
        started.wait()
        for _ in range(9):
            before = counted
            cell.inspect(large)
            progress.append(counted - before)
    finally:
        done.set()
        thread.join()
        sys.setswitchinterval(interval)
    # Some millions when the call runs without the lock; below a hundred thousand when it holds it.
    assert np.median(progress) > 150_000


def test_one_cell_in_several_threads(frame: Frame) -> None:
    cell = samsod.Cell()
    expected = cell.inspect(frame).partition.labels
    same: list[bool] = []
    threads = [
        threading.Thread(target=lambda: same.append(np.array_equal(cell.inspect(frame).partition.labels, expected)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert same == [True] * 4


def test_the_extension_links_little_of_opencv() -> None:
    """Recognition needs OpenCV, but neither its windows nor its codecs, which drag in half a desktop."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("no /proc on this system")
    text = maps.read_text()
    assert "_native.abi3.so" in text
    linked = set(re.findall(r"libopencv_([a-z0-9]+)\.so", text))
    assert linked <= {"calib3d", "core", "features2d", "flann", "imgproc"}


def test_stubs_agree_with_the_module() -> None:
    check = subprocess.run(
        [sys.executable, "-m", "mypy.stubtest", "samsod._native"], capture_output=True, text=True, check=False
    )
    assert check.returncode == 0, check.stdout + check.stderr


def test_everything_public_is_documented() -> None:
    for name in samsod.__all__:
        thing = getattr(samsod, name)
        if name != "__version__":
            assert thing.__doc__, name
        for member, value in vars(thing).items() if isinstance(thing, type) else ():
            if not member.startswith("_"):
                assert value.__doc__, f"{name}.{member}"
