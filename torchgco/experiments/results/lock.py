"""One process at a time writes a study: the same command started twice, or queued again too early, waits.

A study is held whole, or by its share where several jobs fly it: shares of one study are held side by side, but not
beside the whole. Locks are those of the file system (`flock`), also on NFS; they end with their process, however that
ends. Where a file system has none, filelock marks the holder by a file, and recognises a dead one of the same machine.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from torchgco.base.errors import InputError
from torchgco.experiments.results.files import refused

LOCK = ".lock"
HOLDER = ".holder"  # ending of the file that says who holds a lock
MARK = ".mark"  # ending of the file that is the lock where the file system has none
# s until a second start is refused. SLURM queues a job again while its processes of before may end, 30 s by default
# after their signal, and an NFS 4 server gives up the locks of a machine that went down after 90 s.
PATIENCE = 120.0
POLL = 0.2  # s
NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)  # of file systems that are mounted without locks
warnings.filterwarnings("ignore", "flock not supported on this filesystem", UserWarning)  # a marked holder will do


@contextmanager
def held_or_freed(folder: Path, job: int | None, jobs: int | None, free: Callable[[], None]) -> Iterator[None]:
    """As `held`; where the block raises and nobody else holds the study or a share of it, the folder is freed.

    Args:
        free: takes back what claims the folder, where that is this study's and nothing is flown.

    Raises:
        InputError: as `held`.
    """
    try:
        with held(folder, job, jobs):
            yield
    except BaseException:
        with suppress(InputError), held(folder, patience=0.0):
            free()
        raise


@contextmanager
def held(
    folder: Path, job: int | None = None, jobs: int | None = None, patience: float | None = None
) -> Iterator[None]:
    """Hold a study, or the share of job `job` of `jobs`, in this block.

    Where others hold it, a line on stderr says so, and this process waits for them, `patience` at most (s; None:
    PATIENCE).

    Raises:
        InputError: they still hold it then, or the folder can't be written to.
    """
    claim = _Claim(folder, time.monotonic() + (PATIENCE if patience is None else patience))
    lock = claim.whole() if job is None else claim.share(folder / f"{LOCK}-{job}-of-{jobs}")
    try:
        with suppress(OSError):  # only for the lines of others
            since = datetime.now().astimezone().isoformat(" ", "seconds")
            me = {"pid": os.getpid(), "host": platform.node(), "since": since}
            Path(f"{_path(lock)}{HOLDER}").write_text(json.dumps(me))
        yield
    finally:
        _release(lock)


class _Claim:
    """One process's way to a lock, until a moment of `time.monotonic`."""

    def __init__(self, folder: Path, until: float) -> None:
        self.folder, self.until, self.told = folder, until, False
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise refused(folder, error.strerror or error) from None

    def whole(self) -> BaseFileLock:
        """The lock of the whole study, once no share of it is held: with it in hand, none can be taken any more."""
        lock = self.taken(self.folder / LOCK)
        try:
            for path in sorted(self.folder.glob(f"{LOCK}-*-of-*")):
                if path.suffix not in (HOLDER, MARK):
                    _release(self.taken(path))
        except BaseException:
            _release(lock)
            raise
        return lock

    def share(self, path: Path) -> BaseFileLock:
        """The lock of a share, taken while nobody holds the whole."""
        while True:
            whole = self.taken(self.folder / LOCK)
            try:
                if (lock := _tried(path)) is not None:
                    return lock
            finally:
                _release(whole)  # others take their shares meanwhile
            self.wait(path)

    def taken(self, path: Path) -> BaseFileLock:
        while (lock := _tried(path)) is None:
            self.wait(path)
        return lock

    def wait(self, path: Path) -> None:
        """Wait a moment for the holder of a lock; InputError when that has taken too long."""
        left = self.until - time.monotonic()
        if left <= 0:
            which = f"{self.folder}, in which {_holder(path)} flies it (no such process? remove {path})"
            raise InputError("hydra.run.dir", "a study that no other process flies", which)
        if not self.told and Path(f"{path}{HOLDER}").exists():  # not of who takes a share
            self.told = True
            line = f"torchgco: {_holder(path)} flies this study in {self.folder}; waiting {PATIENCE:g} s for it at most"
            print(line, file=sys.stderr, flush=True)
        time.sleep(POLL)


def _tried(path: Path) -> BaseFileLock | None:
    """The lock of a path, None where another process holds it."""
    try:
        try:
            return _acquired(FileLock(path))
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            return _acquired(SoftFileLock(f"{path}{MARK}"))
    except Timeout:
        return None
    except OSError as error:
        raise refused(path, error.strerror or error) from None


def _acquired(lock: BaseFileLock) -> BaseFileLock:
    lock.acquire(timeout=0)
    return lock


def _release(lock: BaseFileLock) -> None:
    """Release a lock, and leave no file: who waits for one that is gone makes another."""
    path = _path(lock)
    with suppress(OSError):
        Path(f"{path}{HOLDER}").unlink(missing_ok=True)
        if path.stat().st_size == 0:  # else filelock's own mark, which it removes
            path.unlink()
    lock.release()


def _path(lock: BaseFileLock) -> Path:
    return Path(str(lock.lock_file).removesuffix(MARK))


def _holder(path: Path) -> str:
    try:
        holder = json.loads(Path(f"{path}{HOLDER}").read_bytes())
        return f"process {holder['pid']} on {holder['host']} (since {holder['since']})"
    except (OSError, ValueError, TypeError, KeyError):
        return "another process"
