"""The evaluation command on a small made-up data folder."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from made_up import CAMERA, write_scene
from PIL import Image

from samsod.evaluation import cell
from samsod.evaluation.__main__ import main
from samsod.evaluation.cell import Inspection, SceneScore, score_scene
from samsod.evaluation.data import DataError, SceneData, SceneInfo, TrueCamera, find_split, list_scenes, load_scene
from samsod.evaluation.files import FILES
from samsod.evaluation.tables import group_by


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "dev"
    write_scene(folder, "0001", 2)
    write_scene(folder, "0002", 3)
    scenes = [
        {"scene": "0001", "scenario": "generic", "table": "grey", "lighting": "side"},
        {"scene": "0002", "scenario": "oblique", "table": "grey", "lighting": "dome"},
    ]
    (folder / "index.json").write_text(json.dumps({"split": "dev", "scenes": scenes}))
    return tmp_path / "data"


def test_command_writes_report_table_and_sheets(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["cell", str(root), "--out", str(out), "--sheets", "1", "--exact"]) == 0
    printed = capsys.readouterr()
    assert "2/2" in printed.err
    report = (out / "evaluation.md").read_text()
    assert report in printed.out
    assert "| not oblique | 1 | 2 | 100.0 |" in report
    assert "| oblique | 1 | 3 | 100.0 |" in report
    assert "in 2 of 2 scenes" in report
    with (out / "scenes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["scene"] for row in rows] == ["0001", "0002"]
    assert [row["found"] for row in rows] == ["2", "3"]
    # How good the regions are is not this test's business.
    assert 0.5 < float(rows[0]["iou"]) <= 1.0
    (sheet,) = out.glob("worst-01-*.png")
    with Image.open(sheet) as image:
        assert image.size == (4 * 720, 540 + 22)
    (sheet,) = out.glob("objects-01-*.png")
    with Image.open(sheet) as image:
        assert image.size == (3 * 960, 720 + 22)


def test_summary_parts_and_histograms(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["cell", str(root / "dev"), "--out", str(out)]) == 0
    figures = json.loads((out / "summary.json").read_text())
    groups = ["scenes", "detection", "objects", "recognition", "angle_deg", "place_mm", "timings_ms"]
    assert list(figures) == [*groups, "by", "calibration"]
    assert figures["calibration"] is None
    printed = capsys.readouterr()
    assert "Not measured: there is no calib/calib.json" in printed.out
    # Without templates it goes on, and says so.
    assert "recognition is not measured: there are no templates/" in printed.err
    assert "## Recognition\n\nNot measured: there are no templates/" in printed.out
    assert {key: list(values) for key, values in figures["by"].items()} == {
        "table": ["grey"],
        "lighting": ["side"],
        "scenario": ["generic", "oblique"],
    }
    oblique = figures["by"]["scenario"]["oblique"]
    # Overall is the one scene that is not oblique.
    assert {key: figures[key] for key in groups} == figures["by"]["scenario"]["generic"]
    assert (figures["scenes"], oblique["scenes"]) == (1, 1)
    for group, parts in ((figures, 2), (oblique, 3)):
        assert group["detection"] == {"parts": parts, "found": parts, "rate": 1.0, "spurious_per_scene": 0.0}
        separation = ["iou", "iou_paper_side", "shadow_recall", "object_loss", "missing"]
        recognised = [f"{name}_recognised" for name in ("iou", "shadow_recall", "object_loss", "missing")]
        assert list(group["objects"]) == [*separation, *recognised]
        assert [group["objects"][name] for name in recognised] == [None] * 4
        assert group["place_mm"]["recognised"] == {"x": None, "y": None}
        assert list(group["timings_ms"]) == ["segment", "saliency", "regions", "shadow", "recognize"]
        assert group["timings_ms"]["recognize"] is None
        assert set(group["recognition"]) == {"shape", "sift_textured", "best", "false_names", "false_names_by_method"}
        assert group["recognition"]["best"] is None
        assert group["angle_deg"] == {"shape": None, "sift": None}
        assert group["place_mm"]["part"] == {"x": None, "y": None}
        assert group["objects"]["missing"] == 0
        # Squares with crisp shadows of 6 px on one side: the region's centroid is up to 3 px off, 2.7 mm, or a
        # pixel more or less. How good the separation is is not this test's business.
        assert 0.5 < group["objects"]["iou"] <= 1.0
        assert group["place_mm"]["before"]["x"] == pytest.approx(2.2, abs=1.0)
        assert group["place_mm"]["after"]["x"] < 4.0
        assert group["place_mm"]["before"]["y"] < 0.5
    with (out / "parts.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["scene"], row["part"]) for row in rows] == [
        ("0001", "square_0"),
        ("0001", "square_1"),
        ("0002", "square_0"),
        ("0002", "square_1"),
        ("0002", "square_2"),
    ]
    assert {row["detected"] for row in rows} == {"True"}
    # The first square covers columns 15..34 and rows 30..49.
    assert float(rows[0]["true_x_mm"]) == pytest.approx(0.9 * (24.5 - 60.0))
    assert float(rows[0]["true_y_mm"]) == pytest.approx(-0.9 * (39.5 - 45.0))
    # The shadow lies on the right, so the place before is too far right.
    assert float(rows[0]["before_error_x_mm"]) > 0.0
    for name in ("error-x.png", "error-y.png"):
        with Image.open(out / name) as image:
            assert image.width > 800


def test_places_do_not_depend_on_the_size_of_the_frames(root: Path, tmp_path: Path) -> None:
    for scale in ("1", "0.5"):
        assert main(["cell", str(root), "--scale", scale, "--out", str(tmp_path / scale)]) == 0
    places = []
    for scale in ("1", "0.5"):
        with (tmp_path / scale / "parts.csv").open() as file:
            places.append([(float(r["true_x_mm"]), float(r["true_y_mm"])) for r in csv.DictReader(file)])
    # The masks are reduced to the nearest pixel, which may be the next one.
    assert np.allclose(places[0], places[1], atol=1.0)
    # The outer edges of the picture stay where they are, half a pixel outside of the outer pixel centres.
    camera = TrueCamera(np.array(CAMERA["K"]), np.zeros(5), np.eye(4)).resized(0.5, 0.25)
    assert camera.matrix.tolist() == [[500.0, 0.0, 29.75], [0.0, 250.0, 10.875], [0.0, 0.0, 1.0]]


def test_calibration_that_fails_spoils_the_rest_of_nothing(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = root / "calib" / "images"
    images.mkdir(parents=True)
    Image.new("L", (9, 9)).save(images / "01.jpg")
    truth = {"K_true": CAMERA["K"], "dist_true": CAMERA["dist"], "pattern_inner_corners": [9, 6], "square_mm": 20}
    (root / "calib" / "calib.json").write_text(json.dumps(truth))
    script = tmp_path / "samsod"
    script.write_text("#!/bin/sh\necho no board >&2\nexit 1\n")
    script.chmod(0o755)
    out = tmp_path / "out"
    # Without --out there is nowhere to write the camera file.
    assert main(["cell", str(root), "--samsod", str(script)]) == 0
    assert "Not measured: it needs --out" in capsys.readouterr().out
    assert main(["cell", str(root), "--out", str(out), "--samsod", str(script)]) == 1
    assert "calibrate ended with code 1: no board" in capsys.readouterr().err
    assert "Not measured: " in (out / "evaluation.md").read_text()
    figures = json.loads((out / "summary.json").read_text())
    assert figures["scenes"] == 1
    assert figures["calibration"] is None


def test_only_own_files_are_replaced(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert main(["cell", str(root), "--out", str(out), "--sheets", "1"]) == 0
    written = {path.name for path in out.iterdir()} - {"notes.txt"}
    assert {name for name in written - set(FILES) if not name.endswith(".png")} == {".samsod-evaluation"}
    assert len(list(out.glob("worst-01-*.png"))) == len(list(out.glob("objects-01-*.png"))) == 1
    # The sheets of the first run are gone after the second, which makes none.
    assert main(["cell", str(root), "--out", str(out)]) == 0
    assert not list(out.glob("worst-*.png"))
    assert not list(out.glob("objects-*.png"))
    assert (out / "notes.txt").read_text() == "mine"

    other = tmp_path / "other"
    other.mkdir()
    (other / "summary.json").write_text("mine")
    capsys.readouterr()
    assert main(["cell", str(root), "--out", str(other)]) == 2
    assert "summary.json: was not written by this evaluation" in capsys.readouterr().err
    assert [path.name for path in other.iterdir()] == ["summary.json"]
    assert (other / "summary.json").read_text() == "mine"
    assert main(["cell", str(root), "--out", str(other / "summary.json")]) == 2
    assert "summary.json: not a folder" in capsys.readouterr().err


def test_command_with_options(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cell", str(root), "--threshold", "1", "--scenes", "0001", "--repeat", "2"]) == 0
    report = capsys.readouterr().out
    assert "| not oblique | 1 | 2 | 0.0 | 100.0 |" in report
    assert "- 0001 (grey, side, generic): square_0, square_1" in report
    config = tmp_path / "cell.toml"
    config.write_text("[regions]\nthreshold = 1.0\n")
    assert main(["cell", str(root), "--config", str(config), "--scale", "0.5"]) == 0
    assert "| not oblique | 1 | 2 | 0.0 | 100.0 |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--split", "test"], "no split 'test'; it has dev"),
        (["--samsod", "/nowhere/samsod"], "/nowhere/samsod: no such program"),
        (["--scenes", "7"], "no scene 7"),
        (["--leave-out", "bolt"], "--leave-out bolt: there are no templates/"),
        (["--threshold", "nan"], "threshold = NaN"),
        (["--threshold", "often"], 'threshold = "often"'),
        (["--config", "/nowhere/cell.toml"], "/nowhere/cell.toml"),
        (["--config", "x.toml", "--threshold", "0.1"], "exclude each other"),
    ],
)
def test_command_errors(root: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["cell", str(root), *options]) == 2
    assert message in capsys.readouterr().err


def test_stages_of_a_picture(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stages.png"
    image = root / "dev" / "images" / "0002.jpg"
    assert main(["stages", str(image), "--out", str(out), "--width", "60"]) == 0
    assert "3 regions" in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.size == (4 * 60, 45)
    assert main(["stages", str(root / "none.jpg"), "--out", str(out)]) == 2
    assert "none.jpg: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options", [["--sheets", "2"], ["--repeat", "0"], ["--scale", "0"], ["--sheets", "-1"], ["--conventional", "-1"]]
)
def test_command_usage_errors(root: Path, options: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["cell", str(root), *options])
    assert stop.value.code == 2


def test_data_may_be_a_folder_of_scenes_or_the_one_above(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dev = root / "dev"
    assert find_split(root) == dev
    assert find_split(dev) == dev
    assert find_split(dev, "dev") == dev
    monkeypatch.chdir(dev)
    assert find_split(Path(), "dev").resolve() == dev
    # With several, dev is taken; without dev it must be said which.
    (root / "test").mkdir()
    (root / "test" / "index.json").write_text("{}")
    assert find_split(root) == dev
    assert find_split(root, "test") == root / "test"
    dev.rename(root / "more")
    with pytest.raises(DataError, match="has the splits more, test; choose one with --split"):
        find_split(root)
    (root / "test" / "index.json").unlink()
    assert find_split(root) == root / "more"
    with pytest.raises(DataError, match="more: a folder of scenes itself, without a split 'dev'"):
        find_split(root / "more", "dev")


def test_bad_folders_are_named_and_nothing_is_written(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "file").write_text("")
    for folder, message in (("nowhere", "no such folder"), ("empty", "no index.json"), ("file", "not a folder")):
        assert main(["cell", str(tmp_path / folder), "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert f"{tmp_path / folder}: {message}" in error
        assert "expected a folder of scenes (index.json, images/, masks/, shadows/, gt/)" in error
    gt = root / "dev" / "gt" / "0002.json"
    gt.unlink()
    assert main(["cell", str(root), "--out", str(out)]) == 2
    assert f"{gt}: no such file" in capsys.readouterr().err
    assert not out.exists()


def test_missing_and_broken_files_are_named(root: Path) -> None:
    dev = root / "dev"
    info = list_scenes(dev)[0]
    gt = dev / "gt" / "0001.json"
    camera = load_scene(info).camera
    assert camera is not None
    assert camera.matrix[0].tolist() == [1000.0, 0.0, 60.0]
    for key, value in (("K", [[1.0]]), ("dist", [0.0]), ("T_world_camera", [[float("nan")] * 4] * 4)):
        gt.write_text(json.dumps({"instances": [], **CAMERA, key: value}))
        with pytest.raises(DataError, match=rf"0001\.json: not the truth of a scene .*{key} has shape"):
            load_scene(info)
    gt.write_text(json.dumps({"instances": []}))
    with pytest.raises(DataError, match="KeyError\\('K'\\)"):
        load_scene(info)
    gt.write_text(json.dumps({"instances": [], **CAMERA}))

    shadow = dev / "shadows" / "0001.png"
    shadow.write_text("no image")
    with pytest.raises(DataError, match=r"shadows/0001\.png: not an image"):
        load_scene(info)
    Image.new("L", (3, 3)).save(shadow)
    with pytest.raises(DataError, match=r"size \(3, 3\) differs from the image's \(120, 90\)"):
        load_scene(info)
    Image.new("P", (120, 90)).save(shadow)
    with pytest.raises(DataError, match="pixel mode P; a mask must be 8-bit grey"):
        load_scene(info)
    shadow.unlink()
    with pytest.raises(DataError, match=r"shadows/0001\.png: no such file"):
        load_scene(info)
    with pytest.raises(DataError, match=r"shadows/0001\.png: no such file, but .* lists the scene '0001'"):
        list_scenes(dev)
    for text, message in (
        ("{}", "not an index of scenes"),
        ("{", r"index\.json: Expecting"),
        ('{"scenes": []}', "no scenes"),
    ):
        (dev / "index.json").write_text(text)
        with pytest.raises(DataError, match=message):
            list_scenes(dev)


def test_score_of_a_scene_worked_by_hand() -> None:
    """Part 1 is covered wholly, part 2 by a quarter; a region on the bare table is spurious.

    ::

        parts    labels     salient: partitions 1, 2 and 3
        1 1 0 2  1 1 0 2
        0 0 0 2  0 0 0 0
        0 0 0 2  0 0 0 0
        0 0 0 2  3 0 0 0
    """
    parts = np.zeros((4, 4), dtype=np.uint8)
    parts[0, :2] = 1
    parts[:, 3] = 2
    labels = np.zeros((4, 4), dtype=np.uint32)
    labels[0, :2] = 1
    labels[0, 3] = 2
    labels[3, 0] = 3
    data = SceneData(np.zeros((4, 4, 3), dtype=np.uint8), parts, np.zeros((4, 4), dtype=bool), {1: "bolt", 2: "rail"})
    result = Inspection(
        labels=labels,
        means=np.zeros((4, 3), dtype=np.float32),
        saliency=np.zeros((4, 4), dtype=np.float32),
        regions=[[1], [2], [3]],
        timings_ms={"segment": 1.0, "saliency": 2.0, "regions": 3.0, "shadow": 4.0},
    )
    score = score_scene(SceneInfo("0001", Path(), "generic", "grey", "side"), data, result)
    assert (score.parts, score.found, score.cut, score.merged) == (2, 1, 1, 0)
    assert (score.regions, score.spurious, score.partitions) == (3, 1, 4)
    assert score.missed_ids == [2]
    assert score.missed_parts == ["rail"]
    # Salient are four pixels, three of them true; six pixels are true.
    assert score.iou == pytest.approx(3 / 7)
    assert score.precision == pytest.approx(3 / 4)
    assert score.recall == pytest.approx(3 / 6)
    # Without the spurious partition.
    assert score.bound_iou == pytest.approx(3 / 6)
    assert (score.segment_ms, score.saliency_ms, score.regions_ms, score.shadow_ms) == (1.0, 2.0, 3.0, 4.0)


def some_score(table: str, found: int, iou: float) -> SceneScore:
    return SceneScore(
        scene="0001",
        scenario="generic",
        table=table,
        lighting="side",
        parts=4,
        found=found,
        cut=4,
        merged=0,
        partitions=10,
        regions=4,
        spurious=1,
        iou=iou,
        bound_iou=1.0,
        precision=1.0,
        recall=iou,
        segment_ms=10.0,
        saliency_ms=5.0,
        regions_ms=1.0,
        shadow_ms=1.0,
    )


def test_groups_weigh_parts_and_average_scenes() -> None:
    scores = [some_score("wood", 4, 1.0), some_score("grey", 2, 0.5), some_score("wood", 3, 0.75)]
    groups = group_by(scores, "table")
    assert [(name, len(group)) for name, group in groups] == [("grey", 1), ("wood", 2)]
    rows = cell.table("table", groups).splitlines()
    assert rows[0].startswith("| table | scenes | parts | found % |")
    assert rows[2].startswith("| grey | 1 | 4 | 50.0 | 100.0 | 0.0 | 1.00 | 0.500 |")
    assert rows[3].startswith("| wood | 2 | 8 | 87.5 | 100.0 | 0.0 | 1.00 | 0.875 |")
    assert all(row.count("|") == rows[0].count("|") for row in rows)
