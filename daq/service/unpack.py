"""A zip from outside becomes a folder: bounded in size, count and depth, and nothing else.

Refused: names that lead elsewhere, links and other special entries, nested folders beyond one,
more than `MOST_FILES` entries, more than `MOST_BYTES` in all (counted while unpacking, not as the
archive declares it), and compression beyond `MOST_RATIO`, which only bombs reach.
"""

import re
import shutil
import stat
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from daq.errors import InputError
from daq.store import slug

MOST_FILES = 5_000
MOST_BYTES = 20_000_000_000
MOST_RATIO = 200
PIECE = 1 << 20


@contextmanager
def unpack(archive: Path, name: str) -> Iterator[Path]:
    """The folder in `archive` that holds `campaign.toml`, until the block ends.

    Raises `InputError` naming the entry that is refused.
    """
    root = Path(tempfile.mkdtemp(prefix="entrain-upload-", dir=archive.parent))
    try:
        target = root / slug(Path(name).stem or "upload")
        target.mkdir()
        try:
            with zipfile.ZipFile(archive) as file:
                _extract(file, target)
        except (zipfile.BadZipFile, NotImplementedError, EOFError, RuntimeError) as error:
            raise InputError(f"{name}: not a readable zip archive ({error})") from error
        yield _campaign_folder(target, name)
    finally:
        shutil.rmtree(root, ignore_errors=True)


def _extract(file: zipfile.ZipFile, target: Path) -> None:
    entries = [entry for entry in file.infolist() if not entry.is_dir()]
    if len(entries) > MOST_FILES:
        raise InputError(f"the archive has {len(entries)} files, more than {MOST_FILES}")
    total = 0
    for entry in entries:
        path = _inside(entry, target)
        path.parent.mkdir(parents=True, exist_ok=True)
        packed = max(1, entry.compress_size)
        size = 0
        with file.open(entry) as source, path.open("xb") as sink:
            while piece := source.read(PIECE):
                size += len(piece)
                total += len(piece)
                if total > MOST_BYTES:
                    raise InputError(f"the archive holds more than {MOST_BYTES} bytes")
                if size > 100 * PIECE and size > MOST_RATIO * packed:
                    raise InputError(
                        f"{entry.filename!r} is packed more than {MOST_RATIO} to one: refused"
                    )
                sink.write(piece)


def _inside(entry: zipfile.ZipInfo, target: Path) -> Path:
    name = entry.filename
    parts = PurePosixPath(name).parts
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if kind not in (0, stat.S_IFREG):
        raise InputError(f"{name!r} is a link or a special file: refused")
    odd = re.search(r"[\x00-\x1f\\:]", name)
    if odd or not parts or ".." in parts or name.startswith("/") or len(parts) > 3:
        raise InputError(f"{name!r} is no plain name inside the archive: refused")
    return target.joinpath(*parts)


def _campaign_folder(root: Path, name: str) -> Path:
    """`root`, or its only folder: archives of a folder often hold the folder itself."""
    if (root / "campaign.toml").is_file():
        return root
    folders = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith("__")]
    if len(folders) == 1 and (folders[0] / "campaign.toml").is_file():
        return folders[0]
    raise InputError(f"{name}: holds no campaign.toml, neither at its top nor in its only folder")
