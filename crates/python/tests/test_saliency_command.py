"""The commands `saliency`, `sensitivity` and `speed` on folders made on the spot, good and bad."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up import write_scene
from PIL import Image
from pyarrow import parquet

from samsod.evaluation.__main__ import main
from samsod.evaluation.data import DataError
from samsod.evaluation.saliency.methods import METHODS
from samsod.evaluation.saliency.pairs import find_pairs, read_mask
from samsod.evaluation.saliency.running import PROGRESS, read_progress
from samsod.evaluation.saliency.scoring import Settings, make_jobs, score_image

NAMES = ("one", "two words", "drei-äöü", "четыре")


def write_image(folder: Path, name: str, at: int, maps: tuple[str, ...] = ("good", "bad")) -> None:
    """A red square on grey; its mask; a map that is the mask and one that is its opposite."""
    rgb = np.full((48, 64, 3), 120, dtype=np.uint8)
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[10:34, at : at + 22] = 255
    rgb[mask > 0] = (200, 40, 40)
    for kind in ("images", "masks", *(f"maps/{method}" for method in maps)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(folder / "images" / f"{name}.png")
    Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
    for method in maps:
        Image.fromarray(mask if method == "good" else 255 - mask).save(folder / f"maps/{method}" / f"{name}.png")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "squares & more"
    for number, name in enumerate(NAMES):
        write_image(folder, name, 8 + 8 * number)
    return folder


def command(root: Path, out: Path, *more: str, maps: bool = True) -> list[str]:
    folders = ["--images", str(root / "images"), "--masks", str(root / "masks")]
    others = ["--maps", f"good={root / 'maps/good'}", "--maps", f"bad={root / 'maps/bad'}"] if maps else []
    return [
        "saliency",
        *folders,
        *others,
        "--out",
        str(out),
        "--jobs",
        "1",
        *(["--no-pictures"] if maps else []),
        *more,
    ]


def rows(out: Path) -> dict[tuple[str, str], dict[str, str]]:
    with (out / "images.csv").open(encoding="utf-8") as file:
        return {(row["image"], row["method"]): row for row in csv.DictReader(file)}


def problems(out: Path) -> list[tuple[str, str, str]]:
    with (out / "problems.csv").open(encoding="utf-8") as file:
        return [(row["kind"], row["name"], row["not_measured"]) for row in csv.DictReader(file)]


def test_everything_is_written(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = [
        argument for argument in command(root, out, "--run", "background,paper") if argument != "--no-pictures"
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    table = rows(out)
    assert set(table) == {(name, method) for name in NAMES for method in ("background", "paper", "good", "bad")}
    for name in NAMES:
        good, bad, ours = (table[name, method] for method in ("good", "bad", "background"))
        assert (float(good["f"]), float(good["mae"]), good["ms"]) == (1.0, 0.0, "")
        assert (float(bad["f"]), float(bad["mae"])) == (0.0, 1.0)
        # A red square on grey is no riddle.
        assert float(ours["f"]) > 0.95
        assert float(ours["mae"]) < 0.05
        assert float(ours["ms"]) > 0.0
    columns = parquet.read_table(out / "images.parquet").to_pydict()
    assert columns["image"] == [row["image"] for row in table.values()]
    assert columns["f"] == [float(row["f"]) for row in table.values()]
    assert [ms is None for ms in columns["ms"]] == [row["ms"] == "" for row in table.values()]
    report = (out / "saliency.md").read_text(encoding="utf-8")
    assert report in printed.out
    assert "| squares & more | shuffled F-measure |" in report
    assert re.search(r"\|  \| F-measure \| [*0-9.]+ \| 0\.\d+ \| \*\*1\.0000\*\* \| 0\.0000 \|", report)
    assert re.search(r"\|  \| MAE \| [*0-9.]+ \| 0\.\d+ \| \*\*0\.0000\*\* \| 1\.0000 \|", report)
    assert "None." in report
    latex = (out / "table1.tex").read_text(encoding="utf-8")
    assert r"squares \& more & shuffled F-measure & " in latex
    assert r"\textbf{1.0000} & 0.0000 \\" in latex
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["methods"]["good"]["shuffled_auc"] > summary["methods"]["bad"]["shuffled_auc"]
    assert (summary["images"], summary["problems"]) == (4, {})
    with (out / "sweeps.csv").open() as file:
        sweep = [row for row in csv.DictReader(file) if row["method"] == "good"]
    assert len(sweep) == 256
    assert {row["f"] for row in sweep[1:]} == {"1.000000"}
    for stem in ("curves", "histograms", "stages", "sheet-worst", "sheet-middle", "sheet-best"):
        with Image.open(out / f"{stem}.png") as picture:
            assert min(picture.size) > 100
        assert "<svg" in (out / f"{stem}.svg").read_text(encoding="utf-8")[:1000]


def test_a_second_run_measures_only_what_changed(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(command(root, out)) == 0
    first = (out / "images.csv").read_bytes()
    capsys.readouterr()
    # As an interrupted run leaves it: the last line is cut short.
    lines = (out / PROGRESS).read_text(encoding="utf-8").splitlines(keepends=True)
    (out / PROGRESS).write_text("".join(lines[:3]) + lines[3][:100], encoding="utf-8")
    assert len(read_progress(out / PROGRESS)) == 3
    assert main(command(root, out)) == 0
    printed = capsys.readouterr().err
    assert "measured 1 images" in printed
    assert "3 images were measured by an earlier run" in printed
    with (out / "images.csv").open() as file:
        second = [{**row, "ms": ""} for row in csv.DictReader(file)]
    assert second == [{**row, "ms": ""} for row in csv.DictReader(first.decode().splitlines())]
    # Another map, another result; the negative references of the others hold.
    Image.fromarray(np.eye(48, 64, dtype=np.uint8) * 255).save(root / "maps/good" / "one.png")
    assert main(command(root, out)) == 0
    assert "measured 1 images" in capsys.readouterr().err
    assert float(rows(out)["one", "good"]["f"]) < 0.5
    assert main(command(root, out, "--fresh")) == 0
    assert "measured 4 images" in capsys.readouterr().err
    assert main(command(root, out, "--seed", "1", "--others", "2")) == 0
    assert "measured 4 images" in capsys.readouterr().err


def test_processes_and_one_process_agree(root: Path, tmp_path: Path) -> None:
    assert main(command(root, tmp_path / "a")) == 0
    assert main([*command(root, tmp_path / "b"), "--jobs", "2"]) == 0
    tables = [{key: {**row, "ms": ""} for key, row in rows(tmp_path / name).items()} for name in "ab"]
    assert tables[0] == tables[1]


def test_bad_files_are_named_and_counted(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, name in enumerate(("no mask", "broken mask", "broken image", "sized", "empty", "grey", "few maps")):
        write_image(root, name, 10 + number)
    (root / "masks/no mask.png").unlink()
    (root / "masks/broken mask.png").write_bytes((root / "masks/one.png").read_bytes()[:60])
    (root / "images/broken image.png").write_text("this is no image")
    Image.new("L", (63, 48), 255).save(root / "masks/sized.png")
    Image.new("L", (64, 48), 1).save(root / "masks/empty.png")
    grey = np.array(Image.open(root / "masks/grey.png"))
    grey[20, 20:24] = (127, 128, 3, 200)
    Image.fromarray(grey).save(root / "masks/grey.png")
    (root / "maps/bad/few maps.png").unlink()
    Image.new("L", (10, 48), 255).save(root / "maps/good/few maps.png")
    Image.new("L", (64, 48), 255).save(root / "masks/extra.png")
    Image.new("L", (64, 48), 255).save(root / "maps/good/extra.png")
    (root / "images/notes.txt").write_text("not an image")
    Image.new("RGB", (64, 48)).save(root / "images/one.bmp")
    Image.fromarray(np.zeros((48, 64), dtype=np.uint16)).save(root / "images/deep.png")
    Image.fromarray(np.zeros((48, 64), dtype=np.uint8)).save(root / "masks/deep.png")
    out = tmp_path / "out"
    assert main(command(root, out)) == 0
    found = set(problems(out))
    expected = {
        ("image without a mask", "no mask", "1"),
        ("unreadable mask", "broken mask", "1"),
        ("unreadable image", "broken image", "1"),
        ("unreadable image", "deep", "1"),
        ("mask of another size", "sized", "1"),
        ("mask without a salient pixel", "empty", "1"),
        ("mask with grey values", "grey", "0"),
        ("image without a map of bad", "few maps", "1"),
        ("map of another shape of good", "few maps", "1"),
        ("mask without an image", "extra", "0"),
        ("map of good without an image", "extra", "0"),
        ("not an image among the images", "notes", "0"),
        ("two images of one name", "one", "0"),
        ("image without a map of good", "deep", "1"),
        ("image without a map of bad", "deep", "1"),
    }
    assert found == expected
    table = rows(out)
    for name in ("no mask", "broken mask", "broken image", "sized", "empty", "deep"):
        assert not any(image == name for image, _ in table), name
    # Grey pixels above 127 are truth: 128 and 200 are, 127 and 3 are not, and the map of the square has all four.
    assert float(table["grey", "good"]["recall"]) == 1.0
    assert float(table["grey", "good"]["precision"]) == pytest.approx((24 * 22 - 2) / (24 * 22))
    # A method is measured where it has a map.
    assert ("few maps", "background") in table
    assert not {("few maps", "good"), ("few maps", "bad")} & set(table)
    printed = capsys.readouterr().err
    for line in ("mask of another size: 1 (", "63 x 48 px for an image of 64 x 48 px", "the largest is 1", "I;16"):
        assert line in printed
    report = (out / "saliency.md").read_text(encoding="utf-8")
    for kind, _, _ in expected:
        assert f"- {kind}: " in report
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert sum(summary["problems"].values()) == len(expected)
    assert (summary["methods"]["background"]["images"], summary["methods"]["good"]["images"]) == (6, 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root: [file.unlink() for file in (root / "images").iterdir()], "no image in it"),
        (lambda root: [file.unlink() for file in (root / "masks").iterdir()], "no mask in it"),
        (lambda root: [file.unlink() for file in (root / "maps/good").iterdir()], "no map in it"),
        (lambda root: (root / "masks").rename(root / "elsewhere"), "no such folder"),
        (lambda root: [file.rename(file.with_stem(f"x{file.stem}")) for file in list((root / "masks").iterdir())],
         "no mask has the name of one of the 4 images"),
    ],
)  # fmt: skip
def test_folders_of_nothing(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, message: str
) -> None:
    change(root)
    assert main(command(root, tmp_path / "out")) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_masks_that_cannot_be_used_at_all(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in (root / "masks").iterdir():
        Image.new("L", (64, 48), 0).save(file)
    assert main(command(root, tmp_path / "out")) == 2
    printed = capsys.readouterr().err
    assert "mask without a salient pixel: 4 (" in printed
    assert "no image could be measured" in printed


def test_foreign_files_in_the_output_folder_stay(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "curves.png").write_text("mine")
    assert main(command(root, out)) == 2
    assert (out / "curves.png").read_text() == "mine"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--run", "best"], "--run best: no such method; there are background, "),
        (["--maps", "good"], "expected METHOD=DIR"),
        (["--maps", "paper=x"], "paper is a method that is run"),
        (["--maps", "good=x"], "a method is given twice"),
        (["--size", "2"], "2; must be 8 or more"),
        (["--others", "0"], "0; must be 1 or more"),
    ],
)
def test_wrong_arguments(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    try:
        code: Any = main(command(root, tmp_path / "out", *more))
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert message in capsys.readouterr().err


def test_names_are_paired_however_their_letters_are_stored(root: Path) -> None:
    # One file system composes letters, another does not.
    (root / "masks/drei-äöü.png").rename(root / "masks/drei-a\u0308o\u0308u\u0308.png")
    found = find_pairs(root / "images", root / "masks", {})
    assert [pair.name for pair in found.pairs] == sorted(NAMES)
    assert found.problems == []


def test_negative_references_leave_the_image_out_and_are_seeded(root: Path) -> None:
    pairs = find_pairs(root / "images", root / "masks", {}).pairs
    chosen = {}
    for seed in (0, 1, 2, 3, 4):
        jobs = make_jobs(pairs, Settings(("background",), others=2, seed=seed))
        assert jobs == make_jobs(pairs, Settings(("background",), others=2, seed=seed))
        for job in jobs:
            assert len(set(job.others)) == 2
            assert job.pair.mask not in job.others
        chosen[seed] = tuple(job.others for job in jobs)
    assert len(set(chosen.values())) > 1
    # More than there are: all others.
    for job in make_jobs(pairs, Settings(("background",), others=10)):
        assert set(job.others) == {pair.mask for pair in pairs} - {job.pair.mask}


def test_negative_reference_is_the_union(root: Path) -> None:
    pairs = {
        pair.name: pair for pair in find_pairs(root / "images", root / "masks", {"good": root / "maps/good"}).pairs
    }
    (job,) = (job for job in make_jobs(list(pairs.values()), Settings(())) if job.pair.name == "one")
    (score,) = score_image(job).scores
    masks = {name: read_mask(pair.mask, (64, 48), (64, 48)).salient for name, pair in pairs.items()}
    union = masks["two words"] | masks["drei-äöü"] | masks["четыре"]
    tp = int(masks["one"].sum())
    fp = int((masks["one"] & union).sum())
    assert score.shuffled_f == pytest.approx(2 * tp / (2 * tp + fp), abs=0.02)


def test_size_brings_everything_to_one_size(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(command(root, out, "--size", "32")) == 0
    for row in rows(out).values():
        assert (row["width"], row["height"]) == ("32", "24")
    assert float(rows(out)["one", "good"]["f"]) > 0.9


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_method_finds_a_square_or_says_why_not(root: Path, method: str) -> None:
    if method in ("spectral-residual", "fine-grained"):
        pytest.importorskip("cv2", reason="OpenCV is an extra of its own")
    if method in ("slic", "felzenszwalb"):
        pytest.importorskip("skimage", reason="scikit-image is an extra of its own")
    pair = find_pairs(root / "images", root / "masks", {}).pairs[0]
    result = score_image(make_jobs([pair], Settings((method,)))[0])
    assert result.problems == []
    (score,) = result.scores
    assert score.shuffled_f is None, "no other image"
    assert score.best_f > 0.3


def test_sensitivity_has_the_papers_figures_beside_ours(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = command(root, tmp_path / "out", "--name", "squares", maps=False)
    assert main(["sensitivity", *arguments[1:]]) == 0
    text = capsys.readouterr().out
    assert "{3, 5, 7}/{19, 23, 29} | {3, 5, 7}/{21, 25, 29} | {3, 7, 9}/{15, 19, 29}" in text
    assert "| squares | shuffled F-measure | 0." in text
    assert "| SED2 (paper) | shuffled F-measure | 0.7505 | 0.7495 | 0.7482 | 0.0023 |" in text
    assert (tmp_path / "out/sensitivity.md").read_text(encoding="utf-8") in text


def test_speed_has_the_papers_figures_beside_ours(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (root / "images/broken.png").write_text("no image")
    assert main(["speed", "--images", str(root / "images"), "--run", "background,fast", "--repeat", "1"]) == 0
    printed = capsys.readouterr()
    assert "4 images of 3072 px" in printed.out
    assert re.search(r"\| background \| \d\.\d{6} \|", printed.out)
    assert "| paper's own (paper) | 0.07 |" in printed.out
    assert "unreadable image: 1 (" in printed.err


def test_cell_scenes_before_and_after_separation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scene(tmp_path / "dev", "0001", 2)
    scenes = [{"scene": "0001", "scenario": "generic", "table": "grey", "lighting": "side"}]
    (tmp_path / "dev/index.json").write_text(json.dumps({"split": "dev", "scenes": scenes}))
    assert main(["saliency-cell", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out/saliency-cell.md").read_text(encoding="utf-8")
    assert text in capsys.readouterr().out
    cells = text.splitlines()[-1].strip("| ").split(" | ")
    assert cells[:2] == ["not oblique", "1"]
    # Two squares with shadows: the regions hold both, the objects lose the shadows; there are no templates.
    before, bound, after = (float(cell) for cell in cells[2:5])
    assert before > 0.8
    assert bound >= before
    assert after > 0.8
    assert cells[5] == "-"
    assert main(["saliency-cell", str(tmp_path / "nowhere")]) == 2


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """The address of a Dask scheduler with two workers, each a process of its own."""
    pytest.importorskip("distributed", reason="Dask is an extra of its own")
    address = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    log = (tmp_path / "dask.log").open("w")
    quiet = {"stdout": log, "stderr": subprocess.STDOUT, "cwd": tmp_path}
    started: list[subprocess.Popen[bytes]] = []
    try:
        flags = ["--scheduler-file", str(address), "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        started.append(subprocess.Popen([*dask, *flags], **quiet))  # type: ignore[call-overload]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(address)]
        worker += ["--nworkers", "1", "--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1"]
        started += [subprocess.Popen(worker, **quiet) for _ in range(2)]  # type: ignore[call-overload]
        from distributed import Client

        # The workers wait for the file that the scheduler writes; the client, for the workers.
        client: Any = Client(scheduler_file=str(address), timeout="120s", set_as_default=False)  # type: ignore[no-untyped-call]
        with client:
            client.wait_for_workers(2, timeout=120)
            yield str(client.scheduler.address)
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait()
        log.close()


@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_what_one_process_gives(
    root: Path, tmp_path: Path, scheduler: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(root, tmp_path / "a")) == 0
    assert main(command(root, tmp_path / "b", "--cluster", scheduler)) == 0
    assert "measured 4 images" in capsys.readouterr().err
    tables = [{key: {**row, "ms": ""} for key, row in rows(tmp_path / name).items()} for name in "ab"]
    assert tables[0] == tables[1]


def test_a_cluster_that_is_not_there(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed", reason="Dask is an extra of its own")
    assert main(command(root, tmp_path / "out", "--cluster", "not an address")) == 2
    assert "--cluster not an address: " in capsys.readouterr().err


def test_pairs_refuse_a_file_for_a_folder(root: Path) -> None:
    with pytest.raises(DataError, match="not a folder"):
        find_pairs(root / "images/one.png", root / "masks", {})
