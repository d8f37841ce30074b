"""The folder of an unfinished run: results by key, and large files of the jobs, in ``OUT/.jobs``.

    OUT/.jobs/run.json             study, code version and number of jobs of the last command that ran here
    OUT/.jobs/lock                 locked by the process that runs the study
    OUT/.jobs/results-NNNNNN.pack  results by key, see packs; a whole record marks its job as done
    OUT/.jobs/files/KEY/           large files of a job, renamed to this when the job ended
    OUT/.jobs/files/.begun-*/      large files of a running job
    OUT/.jobs/engine/              files that an engine shares with its workers

The report is written to another folder, which then replaces OUT, including all of this, in one rename.
"""

import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from marlbc_mj.studies import codec
from marlbc_mj.studies.packs import PackWriter, entries, next_pack, packs
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import JOBS_FOLDER, busy, check_folder, duplicate, remove_orphans, write_json, writing
from marlbc_mj.util.locks import exclusive_lock

STORE_SCHEMA = 1
_BEGUN = ".begun-"
_RUN, _LOCK, _FILES, _ENGINE = "run.json", "lock", "files", "engine"


class RunStore:
    """Results and large files of one unfinished run; create it with :func:`open_store`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.files = folder / _FILES
        self.engine = folder / _ENGINE
        self.kept = {entry.key: entry for pack in packs(folder) for entry in entries(pack)}
        """Locations of the stored results by key."""
        self._writer: PackWriter | None = None

    def result(self, key: str) -> Any:
        """The stored result of a job."""
        return codec.from_bytes(self.kept[key].payload())

    def keep(self, key: str, result: Any) -> None:
        """Store the result of a job.

        Raises:
            NoSpaceError: the disk is full.
            ConfigurationError: the result is not data.
        """
        if self._writer is None or self._writer.full:
            self.close()
            self._writer = PackWriter(next_pack(self.folder))
        self.kept[key] = self._writer.add(key, codec.to_bytes(result))

    def drop(self) -> None:
        """Remove all results and files."""
        self.close()
        self.kept.clear()
        for pack in packs(self.folder):
            pack.unlink()
        shutil.rmtree(self.files, ignore_errors=True)

    def close(self) -> None:
        """Flush stored results to the disk and close the pack."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def begin(self, about: Mapping[str, Any]) -> None:
        """Write the description of this run, and remove the files that killed workers left."""
        with writing(self.folder):
            self.files.mkdir(exist_ok=True)
            for path in self.files.glob(f"{_BEGUN}*"):
                shutil.rmtree(path, ignore_errors=True)
        write_json(self.folder / _RUN, {"schema": STORE_SCHEMA, **about})

    def about(self) -> dict[str, Any]:
        """Description of the last run in this folder; empty if there was none.

        Raises:
            ConfigurationError: the folder was written by another version or another program.
        """
        path = self.folder / _RUN
        if not path.exists():
            return {}
        with suppress(OSError, ValueError):
            found = json.loads(path.read_text(encoding="utf-8"))
            if isinstance(found, dict) and found.get("schema") == STORE_SCHEMA:
                return found
        raise ConfigurationError(f"{path} was written by another version of marlbc or by another program; remove {self.folder}")

    def place_files(self, keys: Mapping[str, Any], out: Path) -> None:
        """Link or copy the large files of these jobs into ``out`` under their own names; the store keeps them, too."""
        with writing(out):
            for folder in (self.files / key for key in keys if (self.files / key).is_dir()):
                for path in sorted(each for each in folder.rglob("*") if not each.is_dir()):
                    target = out / path.relative_to(folder)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.unlink(missing_ok=True)
                    duplicate(path, target)


@contextmanager
def job_folder(files: Path | None, key: str) -> Iterator[Path | None]:
    """A temporary folder for the large files of one job, in any process; renamed to the job's key if the block succeeds."""
    if files is None:
        yield None
        return
    begun = files / f"{_BEGUN}{os.getpid()}-{secrets.token_hex(4)}"
    with writing(begun):
        begun.mkdir()
    try:
        yield begun
        with writing(begun):
            if not any(begun.iterdir()):
                begun.rmdir()
                return
            shutil.rmtree(files / key, ignore_errors=True)
            begun.rename(files / key)
    except BaseException:
        shutil.rmtree(begun, ignore_errors=True)
        raise


@contextmanager
def open_store(out: Path, *, overwrite: bool) -> Iterator[RunStore]:
    """Open the store of the run in ``out`` for this process alone; an empty store is removed at the end.

    Raises:
        ConfigurationError: ``out`` holds something that must not be replaced, is a file, cannot be written, or is in use by
            another process.
    """
    remove_orphans(out)
    check_folder(out, overwrite=overwrite)
    folder, made = out / JOBS_FOLDER, not out.exists()
    with writing(out):
        folder.mkdir(parents=True, exist_ok=True)
    with exclusive_lock(folder / _LOCK, busy(out)):
        store = RunStore(folder)
        try:
            yield store
        finally:
            store.close()
            if not store.kept and folder.is_dir():
                shutil.rmtree(folder, ignore_errors=True)
                if made:
                    with suppress(OSError):
                        out.rmdir()
