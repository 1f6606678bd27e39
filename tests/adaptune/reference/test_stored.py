"""Files of estimated references."""

import drives
import made_references
import numpy as np
import pytest

from adaptune.reference.stored import StoredEstimate, write_estimate


def made():
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3] = 0.3 * np.arange(40)
    return made_references.made_of(drives.FIRST_STAMP + np.arange(40) * 10**8, T)


@pytest.mark.parametrize(
    "at", ["adaptune.reference.picture.draw_estimate", "adaptune.reference.stored.write_text"]
)
def test_what_was_known_before_is_not_of_new_poses(tmp_path, monkeypatch, at):
    path = tmp_path / "one.tum"
    write_estimate(path, made(), {"of": 1})
    assert StoredEstimate.read(path).about == {"of": 1}

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(at, interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_estimate(path, made(), {"of": 2})
    assert StoredEstimate.read(path) is None
