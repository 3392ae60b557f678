"""The evaluation command on a small made-up data folder."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from samsod.evaluation import cell
from samsod.evaluation.__main__ import main
from samsod.evaluation.cell import Inspection, SceneScore, score_scene
from samsod.evaluation.data import DataError, SceneData, SceneInfo, list_scenes, load_scene


def write_scene(folder: Path, name: str, parts: int) -> None:
    """A grey table with `parts` dark squares in a row, each with a shadow on its right."""
    rgb = np.full((90, 120, 3), 150, dtype=np.uint8)
    mask = np.zeros((90, 120), dtype=np.uint8)
    shadow = np.zeros((90, 120), dtype=np.uint8)
    for k in range(parts):
        mask[30:50, 15 + 40 * k : 35 + 40 * k] = k + 1
        shadow[30:50, 35 + 40 * k : 41 + 40 * k] = 255
    rgb[shadow > 0] = 90
    rgb[mask > 0] = (30, 60, 120)
    for kind in ("images", "masks", "shadows", "gt"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(folder / "images" / f"{name}.jpg", quality=95)
    Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
    Image.fromarray(shadow).save(folder / "shadows" / f"{name}.png")
    instances = [{"id": k + 1, "part": f"square_{k}"} for k in range(parts)]
    (folder / "gt" / f"{name}.json").write_text(json.dumps({"instances": instances}))


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
    assert printed.err.count("found") == 2
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
    sheets = list(out.glob("worst-01-*.png"))
    assert len(sheets) == 1
    with Image.open(sheets[0]) as sheet:
        assert sheet.size == (4 * 720, 540 + 22)


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
        (["--scenes", "7"], "no scene 7"),
        (["--threshold", "nan"], "threshold = NaN"),
        (["--threshold", "often"], 'threshold = "often"'),
        (["--config", "/nowhere/cell.toml"], "/nowhere/cell.toml"),
        (["--config", "x.toml", "--threshold", "0.1"], "exclude each other"),
    ],
)
def test_command_errors(root: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["cell", str(root), *options]) == 1
    assert message in capsys.readouterr().err


def test_stages_of_a_picture(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "stages.png"
    image = root / "dev" / "images" / "0002.jpg"
    assert main(["stages", str(image), "--out", str(out), "--width", "60"]) == 0
    assert "3 regions" in capsys.readouterr().out
    with Image.open(out) as picture:
        assert picture.size == (4 * 60, 45)
    assert main(["stages", str(root / "none.jpg"), "--out", str(out)]) == 1
    assert "none.jpg: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--sheets", "2"], ["--repeat", "0"], ["--scale", "0"], ["--sheets", "-1"]])
def test_command_usage_errors(root: Path, options: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["cell", str(root), *options])
    assert stop.value.code == 2


def test_missing_and_broken_files_are_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="nowhere: no such folder"):
        list_scenes(tmp_path / "nowhere", "dev")
    with pytest.raises(DataError, match=r"no folder in it has an index\.json"):
        list_scenes(tmp_path / "data" / "dev", "dev")
    info = list_scenes(root, "dev")[0]
    (root / "dev" / "shadows" / "0001.png").unlink()
    with pytest.raises(DataError, match=r"shadows/0001\.png: no such file"):
        load_scene(info)
    (root / "dev" / "shadows" / "0001.png").write_text("no image")
    with pytest.raises(DataError, match=r"shadows/0001\.png: not an image"):
        load_scene(info)
    Image.new("L", (3, 3)).save(root / "dev" / "shadows" / "0001.png")
    with pytest.raises(DataError, match=r"size \(3, 3\) differs from the image's \(120, 90\)"):
        load_scene(info)
    Image.new("P", (120, 90)).save(root / "dev" / "shadows" / "0001.png")
    with pytest.raises(DataError, match="pixel mode P; a mask must be 8-bit grey"):
        load_scene(info)
    (root / "dev" / "index.json").write_text("{}")
    with pytest.raises(DataError, match="not an index of scenes"):
        list_scenes(root, "dev")
    (root / "dev" / "index.json").write_text("{")
    with pytest.raises(DataError, match=r"index\.json: Expecting"):
        list_scenes(root, "dev")
    (root / "dev" / "index.json").write_text('{"scenes": []}')
    with pytest.raises(DataError, match="no scenes"):
        list_scenes(root, "dev")


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
        timings_ms={"segment": 1.0, "saliency": 2.0, "regions": 3.0},
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
    assert (score.segment_ms, score.saliency_ms, score.regions_ms) == (1.0, 2.0, 3.0)


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
    )


def test_groups_weigh_parts_and_average_scenes() -> None:
    scores = [some_score("wood", 4, 1.0), some_score("grey", 2, 0.5), some_score("wood", 3, 0.75)]
    groups = cell.group_by(scores, "table")
    assert [(name, len(group)) for name, group in groups] == [("grey", 1), ("wood", 2)]
    rows = cell.markdown_table("table", groups).splitlines()
    assert rows[0].startswith("| table | scenes | parts | found % |")
    assert rows[2].startswith("| grey | 1 | 4 | 50.0 | 100.0 | 0.0 | 1.00 | 0.500 |")
    assert rows[3].startswith("| wood | 2 | 8 | 87.5 | 100.0 | 0.0 | 1.00 | 0.875 |")
    assert all(row.count("|") == rows[0].count("|") for row in rows)
