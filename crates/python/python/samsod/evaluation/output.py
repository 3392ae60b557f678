"""The folder that the evaluation writes to: only its own files are ever replaced or removed.

The file `.samsod-evaluation` in it lists the names that earlier runs wrote. It is written before any of them, so that
what an interrupted run left behind can be replaced, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from samsod.evaluation.data import DataError

LIST = ".samsod-evaluation"


class OutputFolder:
    """A folder for results, made when it is missing.

    Args:
        path: the folder.
        names: files that this run may write into it.

    Raises:
        DataError: it is not a folder, cannot be written to, or holds a file of one of these names that is not ours.
            Nothing is written then.
    """

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        self.path = path
        if path.exists() and not path.is_dir():
            raise DataError(f"{path}: not a folder; the results need one")
        try:
            listed = (path / LIST).read_text(encoding="utf-8").splitlines() if (path / LIST).is_file() else []
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{path / LIST}: {error}") from error
        # A name is never a path: a list that somebody else wrote must not reach out of the folder.
        self._ours = {name for name in listed if name and Path(name).name == name}
        self.claim(names)

    @property
    def names(self) -> frozenset[str]:
        """Everything that this run or an earlier one wrote, or may write."""
        return frozenset(self._ours)

    def claim(self, names: Iterable[str]) -> None:
        """Makes these files ours, before they are written.

        Raises:
            DataError: one of them exists and was not written by the evaluation.
        """
        names = set(names)
        for name in sorted(names - self._ours):
            if (self.path / name).exists() or (self.path / name).is_symlink():
                raise DataError(
                    f"{self.path / name}: was not written by this evaluation; move it or choose another --out"
                )
        self._ours |= names
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / LIST).write_text("".join(f"{name}\n" for name in sorted(self._ours)), encoding="utf-8")
        except OSError as error:
            raise DataError(f"{self.path}: cannot write results there: {error}") from error

    def clear(self) -> None:
        """Removes what earlier runs wrote, so that no picture of theirs stays among those of this run."""
        for name in self._ours:
            (self.path / name).unlink(missing_ok=True)

    def __truediv__(self, name: str) -> Path:
        """The path of one of our files."""
        if name not in self._ours:
            raise ValueError(f"{name} was not claimed")
        return self.path / name
