"""Writes one run: a thread of its own, a temporary name, SWMR mode, then a rename.

The file exists as ``.NAME.h5.partial`` while it grows and can be read meanwhile
(``h5py.File(path, swmr=True)``); it takes its own name only when it is complete. After a kill the
partial file still opens in SWMR mode and holds all but the blocks since the last flush
(`daq.store_upkeep` salvages it). A failure in the thread (disk full) surfaces at the next
`append` or at `finish`, never silently, and leaves the partial file as a kill would.
"""

import contextlib
import hashlib
import json
import os
import queue
import re
import shutil
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
import numpy.typing as npt

from daq.errors import StoreError
from daq.locks import sync_folder
from daq.records import ExitStatus, RunHeader, RunSummary
from daq.store_file import CHUNK_FRAMES, FLAG_BITS, summarise, write_layout
from drivers.types import Flag

MAX_QUEUED_BYTES = 256 * 2**20  # some 150 s of 8 channels at 51.2 kHz float32
DISK_ERRORS = (OSError, RuntimeError)  # HDF5 raises either where a disk is full
MAX_FILLED_GAP_S = 60.0
METADATA_BYTES = 2**16  # more than HDF5 needs to say where one batch lies
SPARE_BYTES = 2**20  # left free on the disk: for HDF5's own, and for saying how the campaign ended


@dataclass(frozen=True)
class _Piece:
    first_frame: int
    samples: npt.NDArray[Any]
    flags: frozenset[Flag]


def software_version() -> str:
    """The installed distribution's version."""
    try:
        return version("entrain")
    except PackageNotFoundError:
        return "unknown"


def partial_path(path: Path) -> Path:
    """The temporary name of a run that is being written."""
    return path.with_name(f".{path.name}.partial")


class RunWriter:
    """One run on its way to disk.

    Use as a context manager, or call `finish` yourself: leaving the block without it records the
    run as ``aborted``, and on an exception as ``failed`` with the exception as the reason.

    Parameters
    ----------
    path
        Where the finished file goes; its partial file lies beside it.
    header
        What is known when the recording begins.
    flush_s
        The longest time for which samples wait for a flush to the operating system.
    durable
        Force the finished file to the disk (fsync) before the rename.
    """

    def __init__(
        self,
        path: Path,
        header: RunHeader,
        campaign: str,
        *,
        flush_s: float = 0.1,
        durable: bool = True,
    ) -> None:
        self.path = path
        self.header = header
        self.campaign = campaign
        self._flush_s = flush_s
        self._durable = durable
        self._dtype = np.dtype(header.dtype)
        self._pieces: queue.SimpleQueue[_Piece | None] = queue.SimpleQueue()
        self._queued_bytes = 0
        self._room = threading.Condition()
        self._error: BaseException | None = None
        self._hash = hashlib.sha256()
        self._written = 0
        self._next_frame: int | None = None
        self._summary: RunSummary | None = None
        if path.exists():
            raise StoreError(f"{path}: a run of that name exists; runs are never overwritten")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._require_room()
            self._file = h5py.File(partial_path(path), "x", libver="latest", locking=False)
            write_layout(self._file, header, campaign, software_version())
            # Held open: what fails as a data set is closed would be lost without an error.
            self._samples = self._file["entry/data/samples"]
            self._n_valid = self._file["entry/quality/n_valid"]
            self._file.swmr_mode = True
        except FileExistsError as error:
            raise StoreError(
                f"{partial_path(path)}: was left by a recording that broke off; "
                "`entrain store recover` keeps what is in it"
            ) from error
        except DISK_ERRORS as error:
            raise StoreError(f"{path}: cannot be written ({_reason(error)})") from error
        self._thread = threading.Thread(target=self._work, name=f"writer {path.stem}", daemon=True)
        self._thread.start()

    @property
    def queued_bytes(self) -> int:
        """Samples handed over that are not yet written: how far the disk lags."""
        return self._queued_bytes

    def append(
        self,
        samples: npt.NDArray[Any],
        first_frame: int | None = None,
        flags: frozenset[Flag] = frozenset(),
        *,
        patient: bool = False,
    ) -> None:
        """Hand over frames, shape (frames, channels), in volts or in the header's counts.

        Floating-point samples for an integer `dtype` are refused: rounding them is the caller's
        decision. A jump of `first_frame` becomes an entry of the gap list, and the lost frames are
        filled (NaN, or zero counts) so that the time axis stays true. The array is copied. When the
        disk lags too far, a `patient` caller (an importer) waits, a recording fails.
        """
        self._raise_failure()
        if samples.ndim != 2 or samples.shape[1] != len(self.header.channels):
            raise StoreError(
                f"run {self.header.name!r}: a block of shape {samples.shape} does not have "
                f"{len(self.header.channels)} columns"
            )
        if self._dtype.kind == "i" and samples.dtype != self._dtype:
            raise StoreError(
                f"run {self.header.name!r}: {samples.dtype} samples for a {self._dtype} recording"
            )
        piece = _Piece(
            self._expected() if first_frame is None else first_frame,
            np.array(samples, dtype=self._dtype, order="C"),
            flags,
        )
        lost = piece.first_frame - self._expected(piece.first_frame)
        if lost < 0 or lost > MAX_FILLED_GAP_S * self.header.sample_rate_hz:
            raise StoreError(
                f"run {self.header.name!r}: frame {piece.first_frame} cannot follow frame "
                f"{self._expected()}: time ran backwards or the gap is longer than "
                f"{MAX_FILLED_GAP_S:g} s"
            )
        self._next_frame = piece.first_frame + len(samples)
        with self._room:
            if patient:
                self._room.wait_for(
                    lambda: self._queued_bytes < MAX_QUEUED_BYTES // 4 or self._error is not None
                )
            self._queued_bytes += piece.samples.nbytes
        if self._queued_bytes > MAX_QUEUED_BYTES:
            raise StoreError(
                f"run {self.header.name!r}: the disk lags by {self._queued_bytes / 2**20:.0f} MiB; "
                "lower the rate or use a faster disk"
            )
        self._pieces.put(piece)

    def finish(
        self,
        exit_status: ExitStatus = "success",
        reason: str = "",
        notes: Mapping[str, Any] | None = None,
    ) -> RunSummary:
        """Write what is queued, the outcome and the checksum; rename; return the summary.

        Raises `StoreError` when anything could not be written; the partial file then stays.
        """
        if self._summary is not None:
            return self._summary
        self._stop_thread()
        self._raise_failure()
        partial = partial_path(self.path)
        try:
            self._file.close()
            with h5py.File(partial, "r+", libver="latest", locking=False) as file:
                entry = file["entry"].attrs
                entry["exit_status"] = exit_status
                entry["exit_reason"] = reason
                entry["sha256"] = self._hash.hexdigest()
                if notes:
                    entry["notes"] = json.dumps({**self.header.notes, **notes})
            if self._durable:
                with partial.open("rb+") as written:
                    os.fsync(written.fileno())
            os.replace(partial, self.path)
            if self._durable:
                sync_folder(self.path.parent)
        except DISK_ERRORS as error:
            raise StoreError(f"{self.path}: cannot be completed ({_reason(error)})") from error
        self._summary = summarise(
            self.header,
            self.campaign,
            samples=self._written,
            exit_status=exit_status,
            exit_reason=reason,
            sha256=self._hash.hexdigest(),
            bytes=self.path.stat().st_size,
        )
        return self._summary

    def discard(self) -> None:
        """Give the recording up and remove its partial file."""
        self._stop_thread()
        self._file.close()
        partial_path(self.path).unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._summary is not None or not self._file:
            return
        if error is None:
            self.finish("aborted", "left without an outcome")
        elif not isinstance(error, StoreError):
            self.finish("failed", f"{type(error).__name__}: {error}")
        else:
            self._stop_thread()
            if self._error is None:
                self._let_go()

    def _expected(self, first: int = 0) -> int:
        return first if self._next_frame is None else self._next_frame

    def _raise_failure(self) -> None:
        if self._error is not None:
            raise StoreError(
                f"{self.path}: cannot be written ({_reason(self._error)}); what was recorded so "
                f"far is in {partial_path(self.path).name}; `entrain campaign resume` goes on"
            ) from self._error

    def _stop_thread(self) -> None:
        if self._thread.is_alive():
            self._pieces.put(None)
            self._thread.join()

    def _work(self) -> None:
        """The thread: append pieces as they come, flush when none came for a while."""
        try:
            origin: int | None = None
            ended = False
            while not ended:
                batch, ended = self._collect()
                self._reserve(batch)
                for piece in batch:
                    origin = piece.first_frame if origin is None else origin
                    self._write(piece, piece.first_frame - origin)
                if batch:
                    self._file.flush()
                    self._n_valid[()] = self._written  # not before these frames are in the file
                    self._file.flush()
        except BaseException as error:
            self._let_go()
            with self._room:
                self._error = error
                self._room.notify_all()

    def _let_go(self) -> None:
        """Close a file that cannot be written, and leave it on the disk as a kill would.

        Once at most. What HDF5 still has in hand goes nowhere: a close that fails spoils the file,
        and ends the process later (a segmentation fault).
        """
        with contextlib.suppress(*DISK_ERRORS), open(os.devnull, "r+b") as nowhere:
            os.dup2(nowhere.fileno(), self._file.id.get_vfd_handle())
        with contextlib.suppress(*DISK_ERRORS):
            self._file.close()

    def _require_room(self) -> None:
        if (free := shutil.disk_usage(self.path.parent).free) < SPARE_BYTES:
            raise OSError(f"the disk is full, {free / 2**20:.1f} MiB are left: make room")

    def _reserve(self, batch: Sequence[_Piece]) -> None:
        """Have the disk's word for what a batch takes: HDF5 does not survive a write that fails."""
        self._require_room()
        if hasattr(os, "posix_fallocate"):
            wanted = sum(piece.samples.nbytes for piece in batch)
            wanted += 2 * CHUNK_FRAMES * len(self.header.channels) * self._dtype.itemsize
            end = self._file.id.get_filesize()
            os.posix_fallocate(self._file.id.get_vfd_handle(), end, wanted + METADATA_BYTES)

    def _collect(self) -> tuple[list[_Piece], bool]:
        """Wait for a piece, then take what else is there, up to one flush interval's worth."""
        batch: list[_Piece] = []
        piece = self._pieces.get()
        limit = max(1, int(self._flush_s * self.header.sample_rate_hz))
        frames = 0
        while piece is not None:
            batch.append(piece)
            frames += len(piece.samples)
            if frames >= limit or self._pieces.empty():
                return batch, False
            piece = self._pieces.get()
        return batch, True

    def _write(self, piece: _Piece, position: int) -> None:
        samples = self._samples
        end = position + len(piece.samples)
        samples.resize(end, axis=0)
        if position > self._written:
            fill = 0 if self._dtype.kind == "i" else np.nan
            shape = (position - self._written, samples.shape[1])
            lost = np.full(shape, fill, dtype=self._dtype)
            samples[self._written : position] = lost
            self._hash.update(lost.data)
            _append_row(self._file["entry/quality/gaps"], (self._written, shape[0]))
        samples[position:end] = piece.samples
        self._hash.update(np.ascontiguousarray(piece.samples).data)
        if piece.flags:
            bits = sum(1 << FLAG_BITS.index(flag) for flag in piece.flags)
            _append_row(self._file["entry/quality/flags"], (position, len(piece.samples), bits))
        self._written = end
        with self._room:
            self._queued_bytes -= piece.samples.nbytes
            self._room.notify_all()


def _reason(error: BaseException) -> str:
    """Why in a few words: HDF5 says it in ten lines, the system's own words among them."""
    found = re.search(r"error message = '([^']*)'", str(error))
    return found[1] if found else str(getattr(error, "strerror", None) or error)


def _append_row(dataset: h5py.Dataset, row: tuple[int, ...]) -> None:
    dataset.resize(dataset.shape[0] + 1, axis=0)
    dataset[-1] = row
