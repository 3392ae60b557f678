"""Rates and errors over groups of parts, the tables beside the paper, and the command with templates."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from made_up import write_scene, write_templates
from PIL import Image
from test_objects import some_scene

from samsod.evaluation import paper
from samsod.evaluation.__main__ import main
from samsod.evaluation.objects import Place
from samsod.evaluation.paper_tables import paper_tables, times
from samsod.evaluation.recognition import MethodScore, NamedPart, Outcome, RecognitionScore, Stray
from samsod.evaluation.recognition_figures import MethodFigures, RecognitionFigures
from samsod.evaluation.recognition_report import report
from samsod.evaluation.spread import Spread
from samsod.evaluation.summary import Figures, Measured, recognised, summary


def named(outcome: Outcome, **changes: Any) -> NamedPart:
    """A bolt in a generic scene."""
    arguments: dict[str, Any] = {
        "scene": "0001",
        "scenario": "generic",
        "table": "wood",
        "lighting": "side",
        "id": 1,
        "part": "bolt",
        "textured": False,
        "detected": True,
        "known": True,
        "called": {"right": "bolt", "wrong": "nut"}.get(outcome),
        **changes,
    }
    return NamedPart(outcome=outcome, **arguments)


def right(angle: float | None, error: Place, **changes: Any) -> NamedPart:
    return named("right", angle_error_deg=angle, error_mm=error, **changes)


def method(*parts: NamedPart, ms: float = 1.0, spurious: int = 0) -> MethodScore:
    stray = Stray("0001", "nut", 0.6, (1.0, 2.0))
    return MethodScore(list(parts), [stray] * spurious, [], ms)


SHAPE = method(
    right(1.0, (0.5, -1.0)),
    named("wrong"),
    named("unknown", part="rail", textured=True),
    right(None, (1.5, 2.0), part="rail", textured=True),
    right(90.0, (50.0, 50.0), detected=False),
    named("wrong", known=False),
    named("nothing", known=False),
    ms=4.0,
)
SIFT = method(right(2.0, (0.0, 0.0), textured=True), named("nothing", textured=True), named("nothing"), ms=2.0)
BEST = method(right(1.0, (-0.2, 0.4)), named("wrong", known=False), named("unknown", known=False), ms=6.0, spurious=1)


def scene(scenario: str = "generic", **methods: MethodScore) -> Measured:
    """A scene with one part, and its recognition in 1000 pixels."""
    base = some_scene(scenario, "wood", True, 0.5, 1.0)
    naming = RecognitionScore({"shape": SHAPE, "sift": SIFT, "best": BEST, **methods}, 1000)
    timings = {"segment": 1.0, "saliency": 2.0, "regions": 0.5, "shadow": 0.5}
    return Measured(base.score, base.objects, timings, naming)


def test_only_detected_parts_of_the_catalogue_count() -> None:
    figures = MethodFigures.of("shape", [SHAPE])
    assert (figures.parts, figures.right, figures.wrong, figures.unknown, figures.nothing) == (4, 2, 1, 1, 0)
    assert figures.rate == 0.5
    assert (figures.others, figures.false_names, figures.false_name_rate) == (2, 1, 0.5)
    # The part that looks the same at any angle has none.
    assert figures.angle == Spread(1.0, 0.0)
    assert figures.x is not None
    assert figures.x.mean == pytest.approx(1.0)
    assert figures.y is not None
    assert figures.y.mean == pytest.approx(1.5)
    # The conventional methods detect nothing beforehand: all parts count.
    conventional = MethodFigures.of("conventional_shape", [SHAPE])
    assert (conventional.parts, conventional.right) == (5, 3)


def test_figures_of_textured_parts_and_of_one_part() -> None:
    figures = RecognitionFigures.of(recognised([scene()]))
    assert figures.methods["sift"].rate == pytest.approx(1 / 3)
    assert figures.sift_textured.rate == 0.5
    assert MethodFigures.of("shape", [SHAPE], part="rail").rate == 0.5
    assert MethodFigures.of("best", [BEST], part="nut").spurious == 1
    assert MethodFigures.of("best", [BEST], part="bolt").spurious == 0
    nothing = RecognitionFigures.of([]).methods["best"]
    assert (nothing.rate, nothing.false_name_rate, nothing.angle, nothing.ms) == (None, None, None, None)


def test_summary_keys_and_values() -> None:
    figures = summary([scene(), scene("oblique", best=method(named("wrong"), ms=8.0))])
    assert figures["recognition"] == {
        "shape": 0.5,
        "sift_textured": 0.5,
        "best": 1.0,
        "false_names": 0.5,
        "false_names_by_method": {"shape": 0.5, "sift": None, "best": 0.5},
    }
    assert figures["angle_deg"] == {"shape": 1.0, "sift": 2.0}
    assert figures["place_mm"]["part"] == {"x": 0.2, "y": 0.4}
    assert figures["timings_ms"]["recognize"] == 6.0
    # The oblique scene stands under its scenario only.
    oblique = figures["by"]["scenario"]["oblique"]
    assert (oblique["recognition"]["best"], oblique["timings_ms"]["recognize"]) == (0.0, 8.0)
    assert oblique["place_mm"]["part"] == {"x": None, "y": None}
    assert list(oblique) == list(Figures.of([]).groups())
    json.dumps(figures, allow_nan=False)


def test_times_in_milliseconds_a_pixel() -> None:
    found = times([scene(conventional_shape=method(ms=800.0), conventional_sift=method(ms=60.0))])
    assert found.saliency == pytest.approx(3.5e-3)
    assert found.shadow == pytest.approx(0.5e-3)
    assert found.sift == pytest.approx(2e-3)
    assert found.shape == pytest.approx(4e-3)
    assert found.with_sift == pytest.approx(6e-3)
    assert found.with_shape == pytest.approx(8e-3)
    assert found.sift_ratio == pytest.approx(0.1)
    assert found.shape_ratio == pytest.approx(0.01)
    without = times([scene()])
    assert (without.conventional_shape, without.shape_ratio, without.sift_ratio) == (None, None, None)


def test_figures_of_the_paper() -> None:
    assert paper.TIMES.with_sift == pytest.approx(0.176)
    assert paper.TIMES.with_shape == pytest.approx(0.266)
    # The text says 0.36 and 0.0038.
    assert paper.TIMES.sift_ratio == pytest.approx(0.36, abs=0.01)
    assert paper.TIMES.shape_ratio == pytest.approx(0.0038, abs=1e-4)
    assert [row.name for row in paper.SETS] == ["Set2", "Set3", "Set4", "Set5"]
    assert len(paper.OBJECTS) == 6
    # Centimetres have become millimetres.
    assert str(paper.SETS[0].before.x) == "2.30 ± 0.30"
    places = paper.OBJECTS[0].conventional_sift.places
    assert places is not None
    assert str(places.x) == "3.83 ± 0.30"


def test_tables_have_the_papers_rows_and_ours() -> None:
    measured = [scene(conventional_shape=SHAPE, conventional_sift=SIFT), scene("oblique")]
    text = paper_tables(measured)
    for number in range(4, 10):
        assert f"### Table {number}:" in text
    rows = text.splitlines()
    assert "| paper, Set4 | 5.10 ± 0.70 | 41.0 | 2.10 ± 0.20 | 100.0 |" in rows
    assert "| generic | 2.00 ± 0.00 | 50.0 | 1.00 ± 0.00 | 50.0 |" in rows
    assert "| all but oblique | 2.00 ± 0.00 | 50.0 | 1.00 ± 0.00 | 50.0 |" in rows
    assert any(
        row.startswith("| paper, Object6 | 1.60 ± 0.35 | 1.90 ± 0.40 | 1.20 ± 0.40 | 1.50 ± 0.60 |") for row in rows
    )
    assert any(row.startswith("| bolt | ") for row in rows)
    assert any(row.startswith("| 1 scenes with conventional methods | ") for row in rows)
    # Nothing measured is no reason to fail.
    assert "### Table 9:" in paper_tables([])


def test_failures_are_listed() -> None:
    found = BEST.parts[:1]
    best = MethodScore(
        [
            *found,
            named("wrong", id=2, score=0.7, iou=0.8),
            named("nothing", id=3),
            named("unknown", id=4, score=0.4, iou=0.9),
            named("wrong", id=5, part="washer", known=False, called="nut", score=0.6, iou=0.5),
            named("nothing", id=6, detected=False),
        ],
        [Stray("0001", "rail", 0.55, (10.4, 20.6))],
        [],
        1.0,
    )
    text = report([scene(best=best)], None, ["washer"])
    assert "Left out of the catalogue: washer." in text
    head = "0001 (wood, side, generic)"
    assert f"- {head}: bolt, id 2: called nut, score 0.700, IoU 0.80" in text
    assert f"- {head}: bolt, id 3: nothing\n" in text
    assert f"- {head}: bolt, id 4: unknown, score 0.400, IoU 0.90" in text
    assert f"- {head}: washer, id 5: called nut, score 0.600, IoU 0.50" in text
    assert "- 0001: rail at (10, 21), score 0.550" in text
    # Not found by saliency, so not recognition's failure.
    assert "id 6" not in text
    assert report([], "no templates", []) == "## Recognition\n\nNot measured: no templates."


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    for name, parts in (("0001", 2), ("0002", 3)):
        write_scene(folder / "dev", name, parts, poses=True)
    scenes = [
        {"scene": "0001", "scenario": "generic", "table": "grey", "lighting": "side"},
        {"scene": "0002", "scenario": "oblique", "table": "grey", "lighting": "dome"},
    ]
    (folder / "dev" / "index.json").write_text(json.dumps({"split": "dev", "scenes": scenes}))
    write_templates(folder, ["square_0", "square_1", "square_2"])
    return folder


def test_command_with_templates(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    options = ["--out", str(out), "--sheets", "1", "--leave-out", "square_1, square_2", "--conventional", "all"]
    assert main(["cell", str(root), *options]) == 0
    printed = capsys.readouterr()
    assert "Left out of the catalogue: square_1, square_2." in printed.out
    assert "named " in printed.err
    figures = json.loads((out / "summary.json").read_text())
    for group in (figures, figures["by"]["scenario"]["oblique"]):
        # How good the recognition is is not this test's business.
        for rate in ("shape", "sift_textured", "best", "false_names"):
            assert 0.0 <= group["recognition"][rate] <= 1.0
        assert group["timings_ms"]["recognize"] >= 0.0
    with (out / "recognition.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * (2 + 3)
    assert {row["method"] for row in rows} == {"shape", "sift", "best", "conventional_shape", "conventional_sift"}
    assert [row["known"] for row in rows if row["method"] == "best"] == ["True", "False", "True", "False", "False"]
    for name in ("error-angle.png", "conventional-sift.png", "conventional-shape.png"):
        with Image.open(out / name) as image:
            assert image.width > 800
    (sheet,) = out.glob("recognition-01-*.png")
    with Image.open(sheet) as image:
        assert image.size == (2 * 1078, round(90 * 1078 / 120) + 22)
    names = {path.name for path in (out / "catalogue").iterdir()}
    assert names == {".samsod-evaluation", "square_0", "square_1", "square_2"}


def test_command_without_an_output_folder_leaves_no_catalogue(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path / "scratch"))
    monkeypatch.setattr("tempfile.tempdir", None)
    (tmp_path / "scratch").mkdir()
    assert main(["cell", str(root), "--conventional", "0", "--scale", "0.5"]) == 0
    assert list((tmp_path / "scratch").iterdir()) == []
    assert "conventional shape |" not in capsys.readouterr().out.split("## Beside the paper")[0]


def test_command_refuses_what_cannot_be_left_out(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for left_out, message in (
        ("washer", "no part washer to leave out; there are square_0, square_1, square_2"),
        ("square_0,square_1,square_2", "all parts are left out"),
    ):
        assert main(["cell", str(root), "--out", str(out), "--leave-out", left_out]) == 2
        assert message in capsys.readouterr().err
    (root / "templates" / "square_1_mask.png").unlink()
    assert main(["cell", str(root), "--out", str(out)]) == 2
    assert "square_1_mask.png: no such file" in capsys.readouterr().err
    assert not out.exists()
