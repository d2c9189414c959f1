"""Wherever a campaign's id goes, a campaign folder goes too."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from daq.errors import UnknownItem
from daq.importers.folder import import_folder
from daq.store import RunStore


def open_campaign(path_or_id: str | Path, store: RunStore | None = None) -> Path:
    """The folder in a run store of a campaign given by id or as a campaign folder.

    A folder (one with a `campaign.toml`) is imported into `store`; without one, into a store that
    lasts as long as this process. A campaign's own folder inside a run store is taken as it is.

    Raises
    ------
    UnknownItem
        Neither a folder nor the id of a campaign in `store`.
    InputError
        A campaign folder that is not usable: the message says what and where.
    """
    if not str(path_or_id):
        raise UnknownItem("campaign='' is no campaign: give a folder, or an id of the run store")
    folder = Path(path_or_id).expanduser()
    if folder.is_dir():
        if (folder / "campaign.json").exists() and not (folder / "campaign.toml").exists():
            return folder.resolve()
        target = store or _process_store()
        return target.campaign_dir(import_folder(folder, target).id)
    if store is None:
        raise UnknownItem(f"{path_or_id}: no such campaign folder")
    try:
        return store.campaign_dir(str(path_or_id))
    except UnknownItem as error:
        raise UnknownItem(
            f"{path_or_id}: neither a campaign folder nor a campaign in {store.root}; "
            "`entrain campaign list` shows those"
        ) from error


@cache
def _process_store() -> RunStore:
    root = tempfile.mkdtemp(prefix="entrain-")
    store = RunStore(root)
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    atexit.register(store.close)
    return store
