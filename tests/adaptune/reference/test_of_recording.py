import pytest

from adaptune.recording.inspect import inspect
from adaptune.reference.check import recording_config
from adaptune.reference.stored import EstimateError


def test_the_sequence_is_the_one_that_inspect_proposes(study_file, tmp_path):
    found = inspect(study_file.parent / "one.bag")
    config = recording_config(found)
    assert (config.points, config.reference) == ("/points", "/truth")
    assert recording_config(found, "/other", "/gps").points == "/other"
    assert recording_config(found, "/other", "/gps").reference == "/gps"
    poses = tmp_path / "poses.tum"
    poses.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    with pytest.raises(EstimateError, match="file of poses"):
        recording_config(inspect(poses))
