"""What the health check hides: drives of whole recordings without it."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive
from adaptune.metrics import FAILURE
from adaptune.model.rules import BASELINE
from offline.campaign import read_whole_drives
from offline.choice import LOST, BlockErrors, surely_worse
from offline.config import OfflineConfig
from offline.labelled import LabelledData, with_whole_drives
from offline.search import Finished

MOST_ROUNDS = 3
"""How often other finalists take the place of those that fail without the health check."""


def in_whole_drives(
    data: LabelledData,
    archive: Archive,
    config: OfflineConfig,
    drive: Callable[[LabelledData], None] = lambda _: None,
) -> LabelledData:
    """The same with the drives of finalists along whole recordings, see `with_whole_drives`.

    Those that are surely worse than the baseline without the health check, or lose track more
    often, are left out, and others take their place. `drive` makes the drives that are lacking.
    """
    names = [s.name for s in data.sequences]
    for _ in range(MOST_ROUNDS):
        drive(data)
        driven = with_whole_drives(data, archive, config)
        asked = [*driven.finalists(), *driven.sets.defaults]
        bare = read_whole_drives(archive, names, asked, bare=True)
        if not any(bare.values()):
            return driven
        # Where the health check did not act, a drive is bare as it is.
        blocks = with_whole_drives(driven, archive, config, bare).whole_blocks(asked)
        worse = np.array(blocks.trials)[worse_without(blocks)].tolist()
        if not worse:
            return driven
        data = data.subset([n for n in data.sets if n not in worse])
    # Only those that were driven.
    data = data.subset([n for n in data.sets if n in driven.driven])
    return with_whole_drives(data, archive, config)


def worse_without(blocks: BlockErrors) -> NDArray[np.bool_]:
    """Which sets are surely worse than the baseline, or lost in more blocks than it."""
    lost = (blocks.errors >= LOST * FAILURE).sum(axis=0)
    return np.asarray(surely_worse(blocks) | (lost > lost[blocks.baseline]))


def bare_in_words(
    archive: Archive, whole: Finished, fixed: int, dropped: Sequence[int]
) -> tuple[list[str], list[int]]:
    """What fixed set and baseline do without the health check, if that is another thing.

    Beside it: which of the sets that were `dropped` are surely worse so. Others did not drive.
    """
    bare = read_whole_drives(archive, list(whole), [BASELINE, fixed, *dropped], bare=True)
    if not any(bare.values()):
        return [], []
    base, of_fixed = (
        np.mean([bare[name].get(n, of[n]).mean_error for name, of in whole.items()])
        for n in (BASELINE, fixed)
    )
    without = "Without the health check, as in your launch file"
    said = f"{without}, the baseline has {base:.3f} % in training"
    driven = all(fixed in bare[name] or not of[fixed].restarts for name, of in whole.items())
    if fixed != BASELINE and driven:
        said += f", the fixed set {of_fixed:.3f} %"
    if worse := [n for n in dropped if any(n in of for of in bare.values())]:
        said += f"; surely worse, and not recommended: trial {', '.join(map(str, worse))}"
    return [f"{said}."], worse
