"""The worked notebook runs from top to bottom and shows what its text says."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[3] / "examples" / "saliency.ipynb"


@pytest.mark.filterwarnings("default")
def test_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Settings and history of the kernel stay out of the home folder.
    for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "MPLCONFIGDIR", "TMPDIR"):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.setenv(name, str(folder))
    notebook = nbformat.read(NOTEBOOK, as_version=4)  # type: ignore[no-untyped-call]
    assert all(not cell.get("outputs") for cell in notebook.cells), "results are not kept in the repository"
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 2
    printed = "".join(output["text"] for output in outputs if output["output_type"] == "stream")
    assert "no problems" in printed
    row = next(line for line in printed.splitlines() if line.startswith("|  | F-measure |"))
    background, _, _, paper = (float(cell.strip(" *")) for cell in row.strip("|").split("|")[2:])
    assert background > 0.9
    assert background > paper
